"""Hunts that fly: a violation repeats bit for bit; a defect with three causes is found and shrunk to them."""

import json
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml
from federation import PAIR
from forked_commands import run_here
from late_gain import SCENARIO, SPACE, WIND

import zsim

DEFECT = {"gust": "world", "gps_dropout": "drone2", "link_delay": "controller.main/world"}


def hunted(scenario: Path, out: Path, *options: str, code: int) -> dict[str, Any]:
    """Hunt from the command line; return the summary."""
    done = run_here("hunt", str(scenario), "--out", str(out), *options)
    assert done.code == code, done
    return json.loads((out / "summary.json").read_text())


@pytest.mark.soak
def test_a_violation_is_kept_as_a_flight_that_repeats_bit_for_bit(tmp_path: Path) -> None:
    scenario, out = tmp_path / "pair.yaml", tmp_path / "hunt"
    scenario.write_text(PAIR)
    faults = ("imu_stuck at_s=2..3 for_s=1..2", "sonar_stuck")
    words = [word for fault in faults for word in ("--fault", fault)]
    words += ["--duration", "5", "--set", "report.window_s=[3, 5]", "--vary", "wind.gust_m_s=uniform(0, 1)"]
    found = hunted(scenario, out, *words, "--require", "not crashed", "--flights", "9", code=1)["violation"]
    assert [fault["kind"] for fault in found["shrunk"]["faults"]] == ["imu_stuck"]
    assert found["shrunk"]["values"] == {}
    assert [(each["without"], each["alone"]) for each in found["causes"]] == [(1.0, -1.0)]
    run = zsim.load(out / "violation")
    assert run.truth_sha256 == found["truth_sha256"]
    assert "emergency" in {each.kind for each in run.shortfalls} or not run.as_planned
    again = zsim.run(out / "violation.yaml", out=tmp_path / "again", progress=False)
    assert again.truth_sha256 == found["truth_sha256"]
    typed = run_here(
        "run",
        str(scenario),
        *found["options"],
        "--in-process",
        "--set",
        "report.window_s=[3, 5]",
        "--out",
        str(tmp_path / "typed"),
        "--no-report",
    )
    assert (typed.code, zsim.load(tmp_path / "typed").truth_sha256) == (1, found["truth_sha256"])
    assert run_here("rerun", str(out / "violation.zsim")).code == 0
    page = (out / "report.html").read_text()
    assert shlex.join(found["options"][:2]) in page
    assert (out / "violation" / "report.html").exists()
    assert {path.name for path in (out / "figures").iterdir()} == {"margins.png", "pairs.png"}


@pytest.mark.soak
def test_a_planted_defect_is_found_and_shrunk_to_its_three_causes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = tmp_path / "late_gain.yaml"
    scenario.write_text(yaml.safe_dump(SCENARIO))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "support"))
    words = [word for fault in SPACE for word in ("--fault", fault)]
    found = hunted(
        scenario, tmp_path / "hunt", *words, "--vary", WIND, "--require", "late_gain:kept", "--flights", "2400", code=1
    )["violation"]
    assert {fault["kind"]: fault["target"] for fault in found["shrunk"]["faults"]} == DEFECT
    assert found["shrunk"]["values"] == {}
    assert all(each["without"] > 0 and each["alone"] > 0 for each in found["causes"])


@pytest.mark.soak
def test_killing_a_process_changes_no_bit(tmp_path: Path) -> None:
    scenario = tmp_path / "pair.yaml"
    scenario.write_text(PAIR)
    words = ["--fault", "process_kill", "--most", "1", "--require", "same_bits", "--flights", "6", "--duration", "5"]
    assert hunted(scenario, tmp_path / "hunt", *words, code=0)["coverage"] == [
        {"together": 1, "tried": 1, "possible": 1}
    ]


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (["--require", "min_separation > 1"], 2),
        (["--require", "crashed and"], 2),
        (["--require", "not crashed", "--fault", "gusts"], 2),
        (["--require", "not crashed", "--budget", "soon"], 2),
        ([], 2),
    ],
)
def test_an_invalid_hunt_ends_without_a_traceback(near: None, tmp_path: Path, options: list[str], code: int) -> None:
    scenario = tmp_path / "pair.yaml"
    scenario.write_text(PAIR)
    done = run_here(
        "hunt", str(scenario), "--out", str(tmp_path / "hunt"), "--flights", "1", "--duration", "1", *options
    )
    assert (done.code, done.stderr.count("Traceback")) == (code, 0)
