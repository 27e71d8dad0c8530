"""Two runs started at once on one host from one folder do not share ports, keys or files."""

import json
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
from federation import PAIR, Record, Role
from forked_commands import USER_FAULT, run_here
from refused import has_terms
from wire import PATIENCE_S

from zsim.record import RecordReader
from zsim.scenario import scenario_file
from zsim_analysis.in_process import fly
from zsim_deploy.launch.run import DEFAULT_PORT

SLOW, DURATION_S = "0.02", 2.0  # at this rate a run outlasts any test, until the rate is changed
FLIGHT = ("run", "pair.yaml", "--no-report", "--duration", f"{DURATION_S:g}", "--rate", SLOW)
STARTS_S = 120.0  # wall time


@pytest.fixture
def runs(tmp_path: Path, compiled: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Role]]:
    """Two runs of one scenario, as if started in two terminals, and the only ones that the test's `zsim ps` shows."""
    (tmp_path / "pair.yaml").write_text(PAIR)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    inside = ("env", "-C", str(tmp_path))
    with ExitStack() as stack:
        yield [stack.enter_context(closing(Role([*FLIGHT], inside))) for _ in range(2)]


def status() -> dict[str, list[dict[str, Any]]]:
    """Return the rows of `zsim ps` by the run's folder."""
    shown = [json.loads(line) for line in run_here("ps", "--json").stdout.splitlines()]
    return {run["out"]: run["rows"] for run in shown}


def test_concurrent_runs_fly_as_each_would_alone(tmp_path: Path, runs: list[Role]) -> None:
    out = [tmp_path / re.split(" into ", run.line(r"^pair: .* into ", STARTS_S).text)[1] for run in runs]
    for run in runs:
        run.line(r" 0\.0 / 2 s ", STARTS_S)  # its world listens and its processes have been started
    assert len({*out}) == 2
    pids: list[int | None] = [None]
    until_s = time.monotonic() + PATIENCE_S
    while None in pids and time.monotonic() < until_s:  # a process has no pid until it is forked
        rows = status()
        assert set(rows) == {str(folder) for folder in out}
        pids = [row["pid"] for folder in rows for row in rows[folder] if row["state"] != "ended"]
    assert len({*pids}) == len(pids) == 2 * 5  # world, recorder, controller and two estimators
    for options in ((), ("--force",)):
        other = run_here("run", str(tmp_path / "pair.yaml"), "--in-process", "--out", str(out[0]), *options)
        assert other.code == USER_FAULT
        assert has_terms(other.stderr, str(out[0]), "--out")
    endpoints = {endpoint_of(run) for run in runs}
    assert len(endpoints) == 2
    for endpoint in endpoints:
        assert run_here("ask", "world/control", "rate", '{"value": 0}', "--connect", endpoint).code == 0
    fly(scenario_file.load(tmp_path / "pair.yaml", duration_s=DURATION_S), tmp_path / "alone.mcap")
    for run in runs:
        run.ends(with_code=0)
    assert len({hash_of(path) for path in (*(folder / "run.mcap" for folder in out), tmp_path / "alone.mcap")}) == 1


def endpoint_of(run: Role) -> str:
    """Return the endpoint of a run's world: the last one reported, or else the default port."""
    said = re.findall(r"this run is on (tcp/127\.0\.0\.1:\d+)", run.text())
    return said[-1] if said else f"tcp/127.0.0.1:{DEFAULT_PORT}"


def hash_of(path: Path) -> str:
    with RecordReader(path) as reader:
        record = Record(reader)
        assert record.complete
        return record.sha256()


def test_only_one_of_two_simultaneous_runs_gets_a_folder(tmp_path: Path, compiled: None) -> None:
    """Of two runs that start at once, one completes; the other is refused and does not disturb it."""
    (tmp_path / "pair.yaml").write_text(PAIR)
    flight = ["run", str(tmp_path / "pair.yaml"), "--no-report", "--duration", "1", "--out", str(tmp_path / "run")]
    with ExitStack() as stack:
        both = [stack.enter_context(closing(Role([*flight]))) for _ in range(2)]
        codes = sorted(each.process.wait(STARTS_S) for each in both)
    assert codes == [0, USER_FAULT]
    hash_of(tmp_path / "run" / "run.mcap")
