"""User tests with the fixture `federation` of the pytest plugin, mostly run in a separate pytest."""

import os
import re
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import yaml
from federation import PAIR
from refused import refused
from wire import PATIENCE_S

from zsim.errors import RunError, RunFailedError
from zsim.record import RecordReader
from zsim_api.pytest_plugin import Federations

HEAD = """
PAIR = {
    "name": "pair",
    "seed": 3,
    "duration_s": 12,
    "sensors": {"preset": "paper"},
    "drones": [
        {"name": "drone1", "position_m": [2, 0, 0], "yaw_deg": 90},
        {"name": "drone2", "position_m": [-2, 0, 0], "yaw_deg": 90},
    ],
    "clusters": [{"name": "main", "drones": ["drone1", "drone2"], "plan": {"takeoff_s": 0.5}}],
}
"""
PASSING = """
import pytest
from zsim.errors import RunError

def test_gps_dropout_and_a_kill(federation):
    flight = federation(PAIR)
    for mistyped in ("engagd", "restarts", None):
        with pytest.raises(RunError) as refused:
            flight.wait_until(mistyped)
        assert mistyped is None or f"did you mean {mistyped.replace('gd', 'ged').removesuffix('s')}?" in str(refused.value)
    assert flight.t_s == 0
    flight.wait_until("engaged")
    at_s = flight.t_s
    assert 5.0 <= at_s < 5.1, at_s  # time stands still between what a test does
    flight.inject({"kind": "gps_dropout", "target": "drone2", "for_s": 1})
    flight.kill("estimator.drone2")
    assert flight.wait_until("engaged").t_s == at_s  # as it was before
    seen = {("fault", "drone2"), ("death", "estimator.drone2"), ("restart", "estimator.drone2")}
    flight.wait_until(lambda now: seen <= {(event.kind, event.subject) for event in now.events})
    flight.kill("controller.main")
    again = flight.wait_until("restart")  # not the former one
    assert {event.subject for event in again.events if event.kind == "restart"} == {"controller.main"}
    flight.assert_no_collision()
    flight.assert_errors(z_c=0.1, window=(8, 12))
"""
FAILING = """
def test_of_a_program_that_hangs(federation):
    flight = federation(PAIR, programs=["ground.main=sh -c 'echo here on $ZSIM_CONNECT; sleep 600 & wait'"])
    flight.kill("estimator.drone2")
    flight.wait_until("engaged", within_s=1)
"""
KEPT = "test_mine.py-test_of_a_program_that_hangs"  # folder of the failed test


def pytest_run(folder: Path, test: str, *options: str) -> subprocess.Popen[str]:
    """Start pytest on a test as a user would."""
    (folder / "test_mine.py").write_text(HEAD + test)
    return started(["-m", "pytest", "-p", "no:cacheprovider", "--basetemp", str(folder / "tmp"), *options], folder)


def python_run(folder: Path, script: str) -> subprocess.Popen[str]:
    (folder / "script.py").write_text(HEAD + script)
    return started(["script.py"], folder)


def started(words: list[str], folder: Path) -> subprocess.Popen[str]:
    """Start Python in a folder, with standard error merged into its output."""
    environment = {**os.environ, "COLUMNS": "200"}
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def output_of(process: subprocess.Popen[str]) -> str:
    output, _ = process.communicate(timeout=4 * PATIENCE_S)
    return output


def left_in(folder: Path) -> list[int]:
    """Return the processes whose command line contains the folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                line = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if str(folder).encode() in line:
                found.append(int(entry.name))
    return found


def test_a_failed_test_reports_what_it_waited_for_and_keeps_its_record(compiled: None, tmp_path: Path) -> None:
    process = pytest_run(tmp_path, PASSING + FAILING)
    output = output_of(process)
    assert process.returncode == 1, output
    assert "1 failed, 1 passed" in output
    assert [each.name for each in (tmp_path / "runs/failed").iterdir()] == [KEPT]
    assert re.search(r"t = 0.00 s, waiting; waiting_for:\n +ground.main ", output), output
    logs = re.findall(r"^--- (\S+).log(.*)", output, re.MULTILINE)
    names = [name for name, _ in logs]
    launcher = names.index("zsim-run")
    first, others = {*names[:launcher]}, {*names[launcher + 1 :]}
    assert {"estimator.drone2", "ground.main"} <= first  # one was killed, the other is waited for
    assert first | others == {"controller.main", "estimator.drone1", "estimator.drone2", "ground.main", "recorder"}
    assert [bool(rest) for _, rest in logs] == [place > launcher for place in range(len(logs))]  # later logs: one line
    assert re.search("--- ground.main.log\nhere on tcp/127.0.0.1:[0-9]+\n", output)
    kept = tmp_path / "runs/failed" / KEPT / "run1"
    assert f"kept in {kept}" in output
    assert (kept / "logs/ground.main.log").exists()
    with RecordReader(kept / "run.mcap") as reader:
        assert reader.complete
    assert left_in(tmp_path) == []


KILLED_TEST = """
def test_it_is_killed_in_flight(federation):
    flight = federation(PAIR, programs=["sh -c 'setsid sleep 601 & sleep 602'"], options=["--rate", "1"], out="run1")
    flight.wait_until(0.1)
    print("it flies", flush=True)
    flight.run()
"""
KILLED_SCRIPT = """
import zsim

gust = {"kind": "gust", "target": "world", "at_s": 0.1, "for_s": 1, "velocity_m_s": [1, 0, 0]}
zsim.run(PAIR, set={"faults": [gust]}, processes=True, options=["--rate", "1"], out="run1")
"""
SIDE_BY_SIDE = """
import pytest

@pytest.mark.parametrize("number", range(2))
def test_side_by_side(federation, number):
    flight = federation(PAIR, duration=2)
    flight.wait_until(1)
    assert federation(PAIR, duration=1).run().complete  # and another within the same test
    assert flight.run().complete
"""


@pytest.mark.parametrize("kind", [pytest.param("test", marks=pytest.mark.soak), "script"])
def test_a_killed_test_or_script_leaves_nothing_running(compiled: None, tmp_path: Path, kind: str) -> None:
    process = pytest_run(tmp_path, KILLED_TEST, "-s") if kind == "test" else python_run(tmp_path, KILLED_SCRIPT)
    assert process.stdout is not None
    assert any("it flies" in line or "fault: gust" in line for line in process.stdout)
    started = psutil.Process(process.pid).children(recursive=True)
    assert len(started) >= (11 if kind == "test" else 7)  # keepers, launcher, fork server, roles and programs
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(started, PATIENCE_S)
    assert alive == []
    with RecordReader(tmp_path / "run1/run.mcap") as reader:
        assert reader.complete


@pytest.mark.soak
def test_user_tests_can_run_in_parallel(compiled: None, tmp_path: Path) -> None:
    process = pytest_run(tmp_path, SIDE_BY_SIDE, "-n", "2")
    output = output_of(process)
    assert process.returncode == 0, output
    assert "2 passed" in output


def test_the_plugin_loads_nothing_before_a_test_uses_it() -> None:
    loaded = "import pytest, zsim_api.pytest_plugin, sys; print({name.partition('.')[0] for name in sys.modules})"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert "zsim_api" in done.stdout
    assert [name for name in ("numpy", "zenoh", "zsim", "zsim_analysis", "msgspec") if f"'{name}'" in done.stdout] == []


@pytest.mark.parametrize("program", ["ground.main=sleep 600", "sleep 600"], ids=["before time begins", "and after"])
def test_unknown_processes_are_refused_without_waiting(flights: Federations, program: str) -> None:
    flight = flights(yaml.safe_load(PAIR), programs=[program])
    with refused(RunError, "'estimator.drone9'", "estimator.drone1", "estimator.drone2") as raised:
        flight.kill("estimator.drone9")
    assert raised.type is RunError
    if program.startswith("ground.main"):
        with refused(RunFailedError, "ground.main"):
            flight.kill("ground.main", within_s=0)  # a known program that does not join
        with refused(RunError, "ground.main", "ended"):
            flight.start("ground.main")
        with refused(RunError, "'ground.other'", "ground.main"):
            flight.start("ground.other")
