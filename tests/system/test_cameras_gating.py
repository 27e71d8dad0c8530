"""Cameras that gate: as fast as the run goes, no picture is left out, and the truth is what it is without them."""

import pytest
from federation import Federation
from test_cameras import PAIR, PICTURES, SEEN_DEAD

from zsim.errors import ScenarioError
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
    of_all = [round(n * 1e9 / RATE_HZ) for n in range(DURATION_S * RATE_HZ + 1)]
    assert stamps in (of_all, of_all[:-1])  # the last one comes when the run is over
    assert sha256 == without


@pytest.mark.slow
@pytest.mark.soak
def test_a_camera_that_is_killed_holds_time_until_it_is_back(
    tmp_path_factory: pytest.TempPathFactory, compiled: None
) -> None:
    """It is started by the launcher, which knows that the scenario needs it."""
    with Federation(tmp_path_factory.mktemp("killed")) as federation:
        run = federation.run(PAIR, "--duration", "30", "--rate", "4", *GATING)
        client = federation.client()
        pictures, events = client.subscribe(PICTURES), client.subscribe("world/event")
        pictures.until(lambda m: m["t_ns"] > 2_000_000_000)
        federation.kill("camera")
        died_ns = events.until(lambda m: m["kind"] in SEEN_DEAD and m["subject"] == "camera.main").message["t_ns"]
        pictures.until(lambda m: m["t_ns"] > died_ns + 2_000_000_000)
        assert client.request("world/control", "stop")["ok"]
        run.ends(with_code=0)


def test_one_process_has_no_cameras_to_wait_for(tmp_path_factory: pytest.TempPathFactory) -> None:
    place = tmp_path_factory.mktemp("one") / "pair.yaml"
    place.write_text(PAIR)
    with pytest.raises(ScenarioError, match=r"processes\.gating"):
        InProcessFlight(scenario_file.load(place, ["processes.gating=[camera]"]))
