"""Roles as processes: serving run after run, the folder of a record, and the links of a router."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from fake_link import FakeLink
from refused import has_terms, refused

from zsim.contract import keys
from zsim.contract.messages import Info, Origin
from zsim.contract.run_messages import Join
from zsim.errors import NoWorldError, RecordError, RunError
from zsim.runtime.participant import Participant
from zsim.transport.link_watch import Awaited, ClosedLink
from zsim.transport.tls import Identity
from zsim_deploy.roles import roles
from zsim_deploy.roles.roles import RouterLinks, record_folder

ME = "driver.ghost"
INFO = Info(0, 0, 1, "r", "zsim", "lockstep", 1.0, 1, 1, 1, 1, Origin(0.0, 0.0, 0.0), (), (), "", "", "", "")


class NotStopped:
    """A stop channel on which no stop arrives."""

    def stopped(self) -> bool:
        return False

    def reason(self) -> str | None:
        return None

    def exit_if_terminated(self) -> None:
        """Do nothing: there was no signal."""


def test_a_process_that_refuses_a_run_says_goodbye_with_the_reason():
    link: Any = FakeLink()
    participant = Participant(link, INFO, ME)
    stop: Any = NotStopped()

    def serve(*_: object) -> None:
        raise RunError(f"{ME}: no such drone")

    with pytest.raises(RunError):
        roles._serve(serve, link, participant, INFO, stop, print)
    (bye,) = link.published_on(keys.process(ME, "bye"))
    assert bye.reason == "no such drone"


def test_a_server_waits_for_the_next_run_when_a_world_vanishes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`zsim mavlink serve --rate 1`, for example, first requests a pace from the world."""
    said: list[str] = []
    monkeypatch.setattr(roles, "log_printer", lambda _: said.append)
    runs = iter("ab")

    @contextmanager
    def found(*_: object) -> Iterator[tuple[Any, Info]]:
        yield FakeLink(), msgspec.structs.replace(INFO, run_id=next(runs))

    monkeypatch.setattr(roles, "find_world", found)
    served: list[str] = []
    gone = NoWorldError(f"{ME}: nobody answers")
    stop = NotStopped()
    monkeypatch.setattr(stop, "stopped", lambda: len(served) == 2)
    monkeypatch.setattr(roles, "StopChannel", lambda *_: stop)

    def serve(link: Any, info: Info, *_: object) -> None:
        served.append(info.run_id)
        if info.run_id == "a":
            raise gone

    reach: Any = SimpleNamespace(launched=None, wait_s=None, who=Identity(), endpoint="tcp/h:1", federation="zsim")
    roles.serve_runs(ME, serve, reach)
    assert served == ["a", "b"]
    assert str(gone) in said


@pytest.mark.parametrize(
    ("out", "folder"), [("runs/step-{run}", "runs/step-0badcafe"), ("runs/step", "runs/step"), (".", "."), ("{run}/x", "{run}/x")]
)  # fmt: skip
def test_the_run_id_is_put_into_the_last_part_of_a_path(out: str, folder: str) -> None:
    assert record_folder(Path(out), "0badcafe") == Path(folder)


@pytest.mark.parametrize("run_id", ["../../etc", "", "a/b", "a" * 65, "\x1b[2J", ".."])
def test_a_run_id_that_leads_out_of_the_folder_is_refused(run_id: str) -> None:
    with refused(RecordError, "runs/step-{run}", repr(run_id[:40]), "1", "64", "--out"):
        record_folder(Path("runs/step-{run}"), run_id)
    assert record_folder(Path("runs/step"), run_id) == Path("runs/step")


ESTIMATOR, RECORDER, CONSOLE, OWN = "estimator.d1", "recorder", "console.1", "planner.own"


class Case:
    """A router and the lines that it shows."""

    def __init__(self) -> None:
        self.link, self.lines = FakeLink(), list[str]()
        self.links = RouterLinks(self.link, self.lines.append)  # type: ignore[arg-type]

    def joins(self, name: str, period_ns: int = 0, slack_ns: int = 0) -> None:
        role = name.split(".")[0]
        join = Join(0, 0, "run1", 1, role, "here", 7, period_ns, slack_ns=slack_ns)
        self.link.deliver(keys.process(name, "join"), join)

    def names(self) -> set[str]:
        return {name for each in self.links.awaited() for name in each.names}


def test_only_gating_processes_and_recorders_are_awaited() -> None:
    case = Case()
    for name in (ESTIMATOR, RECORDER, CONSOLE):
        case.link.show(keys.session_token(name, name))
    assert case.names() == {ESTIMATOR, RECORDER, CONSOLE}  # without a join, a process may be gating
    case.joins(ESTIMATOR, period_ns=20_000_000)
    case.joins(RECORDER, slack_ns=20_000_000)
    case.joins(CONSOLE)
    assert case.names() == {ESTIMATOR, RECORDER}


def test_a_program_without_a_session_token_is_known_by_its_process_token() -> None:
    case = Case()
    case.joins(OWN, period_ns=20_000_000)
    assert case.links.awaited() == []  # a join without a token
    case.link.show(keys.token(OWN))
    assert case.links.awaited() == [Awaited((OWN,), 7)]
    case.link.show(keys.token(OWN), alive=False)
    assert case.links.awaited() == []


def test_the_number_of_remembered_joins_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roles, "JOINS_MAX", 10)
    case = Case()
    for number in range(105):
        case.link.show(keys.token(f"{OWN}.{number}"))
        case.joins(f"{OWN}.{number}", period_ns=20_000_000)
    assert len(case.names()) == 5
    case.link.deliver(keys.process(OWN, "join"), b"\xc1")
    assert len(case.names()) == 5


def test_a_closed_link_is_reported_with_process_address_and_names() -> None:
    case = Case()
    case.links.watch.closed.append(ClosedLink("192.0.2.7:4000", "pid 9 (python reader.py)", (CONSOLE,), 400_000, 2))
    case.links.report()
    case.links.report()
    (line,) = case.lines
    assert has_terms(line, "pid 9", "192.0.2.7:4000", CONSOLE, "0.4 MB", "2")
