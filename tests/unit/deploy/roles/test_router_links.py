"""Who behind a router must lose nothing, and what is shown of a reader that lost its link."""

import pytest
from fake_link import FakeLink
from refused import has_terms

from zsim.contract import keys
from zsim.contract.run_messages import Join
from zsim.transport.link_watch import Awaited, ClosedLink
from zsim_deploy.roles.roles import RouterLinks

ESTIMATOR, RECORDER, CONSOLE, OWN = "estimator.d1", "recorder", "console.1", "planner.own"


class Case:
    """A router, and the lines that it shows."""

    def __init__(self) -> None:
        self.link, self.lines = FakeLink(), list[str]()
        self.links = RouterLinks(self.link, self.lines.append)  # type: ignore[arg-type]

    def joins(self, name: str, period_ns: int = 0, slack_ns: int = 0) -> None:
        role = name.split(".")[0]
        join = Join(0, 0, "run1", 1, role, "here", 7, period_ns, slack_ns=slack_ns)
        self.link.deliver(keys.process(name, "join"), join)

    def names(self) -> set[str]:
        return {name for each in self.links.awaited() for name in each.names}


def test_who_gates_or_is_recorded_by_must_lose_nothing_and_who_only_reads_may() -> None:
    case = Case()
    for name in (ESTIMATOR, RECORDER, CONSOLE):
        case.link.show(keys.session_token(name, name))
    assert case.names() == {ESTIMATOR, RECORDER, CONSOLE}  # whoever has not said may be waited for
    case.joins(ESTIMATOR, period_ns=20_000_000)
    case.joins(RECORDER, slack_ns=20_000_000)
    case.joins(CONSOLE)
    assert case.names() == {ESTIMATOR, RECORDER}


def test_a_program_without_a_token_of_its_session_is_known_by_its_process() -> None:
    case = Case()
    case.joins(OWN, period_ns=20_000_000)
    assert case.links.awaited() == []  # nobody is behind it
    case.link.show(keys.token(OWN))
    assert case.links.awaited() == [Awaited((OWN,), 7)]
    case.link.show(keys.token(OWN), alive=False)
    assert case.links.awaited() == []


def test_names_without_end_fill_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(router_links, "JOINS_MAX", 10)
    case = Case()
    for number in range(105):
        case.link.show(keys.token(f"{OWN}.{number}"))
        case.joins(f"{OWN}.{number}", period_ns=20_000_000)
    assert len(case.names()) == 5
    case.link.deliver(keys.process(OWN, "join"), b"\xc1")
    assert len(case.names()) == 5


def test_a_link_that_was_closed_is_a_line_with_process_address_and_names() -> None:
    case = Case()
    case.links.watch.closed.append(ClosedLink("192.0.2.7:4000", "pid 9 (python reader.py)", (CONSOLE,), 400_000, 2))
    case.links.report()
    case.links.report()
    (line,) = case.lines
    assert has_terms(line, "pid 9", "192.0.2.7:4000", CONSOLE, "0.4 MB", "2")
