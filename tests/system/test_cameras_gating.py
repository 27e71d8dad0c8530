"""Cameras that gate: as fast as the run goes, no picture is left out, and the truth is what it is without them."""

import pytest
from federation import Federation
from test_cameras import PAIR, PICTURES

from zsim.errors import RunError
from zsim.scenario import scenario_file
from zsim_analysis.in_process import InProcessFlight

GATING = ("--set", "processes.gating=[camera]")
DURATION_S, RATE_HZ = 6, 10


@pytest.mark.slow
def test_no_picture_is_left_out(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> None:
    with Federation(tmp_path_factory.mktemp("gating")) as federation:
        federation.run(PAIR, "--cameras", "--duration", str(DURATION_S), *GATING).ends(with_code=0)
        record = federation.record()
        sha256 = record.sha256()
        stamps = [message["t_sample_ns"] for message in record.all(PICTURES)]
    with Federation(tmp_path_factory.mktemp("without")) as federation:
        federation.run(PAIR, "--in-process", "--duration", str(DURATION_S)).ends(with_code=0)
        without = federation.record().sha256()
    assert stamps == [round(n * 1e9 / RATE_HZ) for n in range(DURATION_S * RATE_HZ + 1)]
    assert sha256 == without


def test_one_process_has_no_cameras_to_wait_for(tmp_path_factory: pytest.TempPathFactory) -> None:
    place = tmp_path_factory.mktemp("one") / "pair.yaml"
    place.write_text(PAIR)
    with pytest.raises(RunError, match=r"processes\.gating"):
        InProcessFlight(scenario_file.load(place, ["processes.gating=[camera]"]))
