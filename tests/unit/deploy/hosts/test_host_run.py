"""How `zsim up` ends when nobody wants to wait for its record, and what is said of a record that there is not."""

import io
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from refused import has_terms
from rich.console import Console

from zsim.errors import HostsError
from zsim.scenario import scenario_file
from zsim_api.run_folder import Launch
from zsim_deploy import inventory
from zsim_deploy.hosts import host_run as module
from zsim_deploy.hosts.host_run import HostRun
from zsim_deploy.hosts.status_table import StatusTable
from zsim_deploy.launch.supervisor import UNREAD, Outcome
from zsim_deploy.roles.closed_output import CLOSED

SCENARIO = "name: one\nduration_s: 1\ndrones: [{name: drone1, position_m: [0, 0, 0]}]\nprocesses: {expect: []}\n"
HOSTS = {
    "hosts": {"h1": {"address": "10.0.0.1", "user": "pi"}},
    "roles": {"world": "h1"},
    "security": {"insecure": True},
}
INTERRUPTED = Outcome("interrupted", interrupted=True)
AT = r"h1:~/\.zsim/runs/abc/run\.mcap \(fetch it with `scp pi@10\.0\.0\.1:\.zsim/runs/abc/run\.mcap \.`\)"


class Said(StatusTable):
    """A board without a terminal."""

    def __init__(self) -> None:
        super().__init__(1.0, Console(file=io.StringIO(), width=500))

    def text(self) -> str:
        assert isinstance(self.console.file, io.StringIO)
        return self.console.file.getvalue()


@pytest.fixture
def board() -> Said:
    return Said()


@pytest.fixture
def up(board: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a run whose host is never asked for."""
    scenario, hosts = tmp_path / "one.yaml", tmp_path / "hosts.yaml"
    scenario.write_text(SCENARIO)
    hosts.write_text(yaml.safe_dump(HOSTS))
    found = HostRun(scenario_file.load(scenario), inventory.load(hosts), tmp_path / "out", Launch("abc"), board)
    monkeypatch.setattr(found._links, "listen", lambda: None)
    yield found
    found._loop.close()


def ends_as(up: Any, outcome: Any, fetched: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the processes of a run and the fetching of its record end so, by a result or an exception."""

    def result_of(found: Any) -> Any:
        if isinstance(found, BaseException):
            raise found
        return found

    async def fetch(*_: Any) -> bool:
        return result_of(fetched)

    monkeypatch.setattr(up._supervisor, "run", lambda _: result_of(outcome))
    monkeypatch.setattr(module, "fetch", fetch)


@pytest.mark.parametrize("early", [True, False], ids=["processes end", "record is fetched"])
def test_a_second_ctrl_c_does_not_wait_and_says_where_the_record_is(
    up: Any, board: Said, monkeypatch: pytest.MonkeyPatch, early: bool
) -> None:
    def interrupt(work: Any) -> None:
        work.close()
        raise KeyboardInterrupt

    ends_as(up, KeyboardInterrupt() if early else INTERRUPTED, True, monkeypatch)
    with monkeypatch.context() as patched:
        patched.setattr(up._loop, "call", interrupt)
        with pytest.raises(KeyboardInterrupt):
            up._fly()
    assert re.search(rf"not fetched.* {AT}", board.text())
    assert has_terms(board.text(), "fetching") is not early


def test_a_run_that_was_ended_before_it_flew_has_no_record(
    up: Any, board: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends_as(up, INTERRUPTED, False, monkeypatch)
    assert up._fly() == INTERRUPTED
    assert has_terms(board.text(), "nothing", "recorded")
    assert not up._record_stays


def test_a_record_that_stays_away_fails_a_run_that_ended_well(up: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ends_as(up, Outcome("duration"), HostsError("h1: gone"), monkeypatch)
    outcome = up._fly()
    assert outcome.failed
    assert has_terms(outcome.reason, "record", "h1: gone", "h1:…")
    assert up._record_stays


@pytest.mark.parametrize("reason", [CLOSED, UNREAD])
def test_a_run_that_nobody_sees_any_more_is_ended_and_lines_are_shown_from_then_on(
    up: Any, board: Said, reason: str
) -> None:
    with board:
        up._signals.reason = reason
        up._signals._hung_up()
        up._look()
        outcome = up._supervisor.run()
        assert (outcome.reason, outcome.interrupted) == (reason, True)
        board.say("fetching")
    assert board.text() == "fetching\n"
