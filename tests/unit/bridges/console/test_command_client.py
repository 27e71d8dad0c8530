"""The console's command client: what it sends, under which name and in what order, and the outcomes it reports."""

import threading
from collections.abc import Iterator
from queue import SimpleQueue
from typing import Any

import pytest
from refused import has_terms

from zsim.contract.run_messages import ControlAnswer
from zsim.errors import SessionError
from zsim_bridges.console.orders import (
    OVERTAKEN,
    PRIORITY,
    PRIORITY_EMERGENCY,
    THREADS_PER_POOL,
    CommandClient,
    RequestOutcome,
)

PATIENCE_S = 120.0


class Link:
    """A session that notes what is asked of it."""

    def __init__(self) -> None:
        self.sent: list[tuple[Any, ...]] = []
        self.refusals: dict[str, str] = {}
        self.given_back = threading.Event()
        self.answers = threading.Event()  # whether anybody answers those who ask for what never ends
        self.held: dict[int, threading.Event] = {}  # by priority, what keeps an acquire from being answered
        self.acquiring: SimpleQueue[int] = SimpleQueue()

    @property
    def modes(self) -> list[str]:
        """What has been sent, in order."""
        return [entry[1].mode for entry in self.sent if len(entry) == 2]

    def request(self, key: str, op: str, source: str, args: dict[str, Any], timeout_s: float) -> ControlAnswer:
        self.sent.append((key, op, source, args))
        if op == "broken":
            raise SessionError("the session is closed")
        if op == "wrong":
            raise ValueError("no such thing")
        if op == "hangs":
            assert self.answers.wait(PATIENCE_S)
        if op == "acquire":
            self.acquiring.put(args["priority"])
            held = self.held.get(args["priority"])
            assert held is None or held.wait(PATIENCE_S)
        if op == "release":
            self.given_back.set()
        refusal = self.refusals.get(op, "")
        return ControlAnswer(ok=not refusal, error=refusal)

    def put(self, key: str, message: Any) -> None:
        self.sent.append((key, message))


class FakeViewBuffer:
    """Hears at once that a command was taken."""

    def answered_commands(self, drone: str) -> int:
        return 0

    def await_answer(self, drone: str, beyond: int, within_s: float) -> None:
        return


class Table:
    """A command client, what it sent, and the outcomes that it reported."""

    def __init__(self) -> None:
        self.link = Link()
        self.outcomes: SimpleQueue[RequestOutcome] = SimpleQueue()
        self.views = FakeViewBuffer()
        self.client = CommandClient(self.link, "console.1", self.views, lambda: 7, self.outcomes.put)  # type: ignore[arg-type]

    def outcome(self) -> RequestOutcome:
        return self.outcomes.get(timeout=PATIENCE_S)


@pytest.fixture
def table() -> Iterator[Table]:
    made = Table()
    yield made
    made.client.close()


def test_a_request_goes_out_in_the_console_s_name(table: Table):
    table.client.request_cluster("main", "target", values={"p": 4.0}, over_s=5.0)
    outcome = table.outcome()
    assert has_terms(outcome.request, "main", "target", "p=4", "over_s 5")
    assert outcome.refusal == ""
    args = {"values": {"p": 4.0}, "over_s": 5.0}
    assert table.link.sent == [("cluster/main/control", "target", "console.1", args)]


def test_waypoints_are_told_by_how_many_they_are(table: Table):
    points = [{"at_s": 10.0 * k, "values": {"x_c": 5.0}} for k in range(3)]
    table.client.request_cluster("main", "trajectory", waypoints=points)
    assert has_terms(table.outcome().request, "main", "waypoints (3)")
    table.client.request_world("fault_add", kind="gust", velocity_m_s=[4.0, 0.0, -1.5])
    assert has_terms(table.outcome().request, "gust", "velocity_m_s 4 0 -1.5")


@pytest.mark.parametrize(
    ("op", "terms"),
    [("pause", ("not now",)), ("broken", ("session", "closed")), ("wrong", ("ValueError", "no such thing"))],
)
def test_a_refusal_or_whatever_goes_wrong_is_told(table: Table, op: str, terms: tuple[str, ...]):
    table.link.refusals["pause"] = "not now"
    table.client.request_world(op)
    outcome = table.outcome()
    assert outcome.request == op
    assert has_terms(outcome.refusal, *terms)


def test_a_page_that_outlives_its_run_is_told_so(table: Table):
    table.client.close()
    table.client.request_world("pause")
    table.client.send_mode(["drone1"], "land")
    outcomes = [table.outcome() for _ in range(2)]
    assert [outcome.request for outcome in outcomes] == ["pause", "drone1: land"]
    assert all(has_terms(outcome.refusal, "run", "ended") for outcome in outcomes)
    assert table.link.sent == []


def test_a_drone_is_taken_told_and_given_back(table: Table):
    table.client.send_mode(["drone1"], "land")
    assert table.outcome()[:2] == ("drone1: land", "")
    assert table.link.given_back.wait(PATIENCE_S)
    acquire, (key, mode), release = table.link.sent
    assert acquire == ("world/control", "acquire", "console.1", {"drone": "drone1", "priority": PRIORITY})
    assert (key, mode.mode, mode.source, mode.t_ns, mode.seq) == ("drone/drone1/cmd/mode", "land", "console.1", 7, 0)
    assert release == ("world/control", "release", "console.1", {"drone": "drone1"})


def test_a_drone_that_another_operator_has_is_not_commanded(table: Table):
    table.link.refusals["acquire"] = "drone1 is flown by 'console.2' with priority 10"
    table.client.send_mode(["drone1"], "takeoff")
    assert has_terms(table.outcome().refusal, "drone1", "'console.2'", "10")
    assert [entry[1] for entry in table.link.sent] == ["acquire"]


def test_an_emergency_reaches_every_drone(table: Table):
    names = [f"drone{i}" for i in range(30)]
    table.client.send_mode(names, "emergency")
    outcomes = {table.outcome()[:2] for _ in names}
    assert outcomes == {(f"{name}: emergency", "") for name in names}
    modes = [entry for entry in table.link.sent if len(entry) == 2]
    assert {key for key, _ in modes} == {f"drone/{name}/cmd/mode" for name in names}


def test_an_emergency_comes_before_whoever_flies_and_is_sent_even_where_the_drone_is_refused(table: Table):
    table.link.refusals["acquire"] = "drone1 is flown by 'console.2' with priority 100"
    table.client.send_mode(["drone1"], "emergency")
    assert has_terms(table.outcome().refusal, "drone1", "'console.2'", "100", "emergency")
    args = {"drone": "drone1", "priority": PRIORITY_EMERGENCY}
    assert table.link.sent[0] == ("world/control", "acquire", "console.1", args)
    assert table.link.modes == ["emergency"]


def test_an_emergency_does_not_wait_for_those_who_do_not_answer(table: Table):
    for _ in range(3 * THREADS_PER_POOL):
        table.client.request_cluster("main", "hangs")
    table.client.send_mode(["drone1"], "emergency")
    assert table.outcome()[:2] == ("drone1: emergency", "")
    assert not table.link.answers.is_set()
    table.link.answers.set()


def test_what_is_given_back_keeps_no_emergency_waiting(table: Table):
    answered = threading.Event()
    table.views.await_answer = lambda *_: answered.wait(PATIENCE_S)  # type: ignore[method-assign, assignment]
    names = [f"drone{i}" for i in range(3 * THREADS_PER_POOL)]
    table.client.send_mode(names, "land")
    assert {table.outcome().request for _ in names} == {f"{name}: land" for name in names}
    table.client.send_mode(names, "emergency")
    assert {table.outcome().request for _ in names} == {f"{name}: emergency" for name in names}
    answered.set()


def test_modes_of_one_drone_go_out_in_the_order_of_the_clicks(table: Table):
    table.link.held[PRIORITY] = threading.Event()
    for mode in ("reset", "takeoff", "land"):
        table.client.send_mode(["drone1"], mode)
    assert table.link.acquiring.get(timeout=PATIENCE_S) == PRIORITY
    table.client.send_mode(["drone2"], "land")
    table.link.acquiring.get(timeout=PATIENCE_S)
    assert [entry[3]["drone"] for entry in table.link.sent] == ["drone1", "drone2"]
    table.link.held[PRIORITY].set()
    requests = [table.outcome().request for _ in range(4)]
    assert [what for what in requests if "drone1" in what] == ["drone1: reset", "drone1: takeoff", "drone1: land"]
    sent = [entry[1].mode for entry in table.link.sent if entry[0] == "drone/drone1/cmd/mode"]
    assert sent == ["reset", "takeoff", "land"]


def test_nothing_that_was_asked_for_before_an_emergency_is_sent_after_it(table: Table):
    table.link.held[PRIORITY] = threading.Event()
    table.client.send_mode(["drone1"], "takeoff")
    assert table.link.acquiring.get(timeout=PATIENCE_S) == PRIORITY
    table.client.send_mode(["drone1"], "land")
    table.client.send_mode(["drone1"], "emergency")
    assert table.outcome()[:2] == ("drone1: emergency", "")
    table.link.held[PRIORITY].set()
    assert table.outcome()[:2] == ("drone1: takeoff", OVERTAKEN)
    assert table.outcome()[:2] == ("drone1: land", OVERTAKEN)
    assert table.link.modes == ["emergency"]


def test_the_end_of_an_emergency_comes_after_it(table: Table):
    table.link.held[PRIORITY_EMERGENCY] = threading.Event()
    table.client.send_mode(["drone1"], "emergency")
    assert table.link.acquiring.get(timeout=PATIENCE_S) == PRIORITY_EMERGENCY
    table.client.send_mode(["drone1"], "reset")
    table.client.send_mode(["drone2"], "land")
    assert table.outcome()[:2] == ("drone2: land", "")
    table.link.held[PRIORITY_EMERGENCY].set()
    assert table.outcome()[:2] == ("drone1: emergency", "")
    assert table.outcome()[:2] == ("drone1: reset", "")
    assert table.link.modes == ["land", "emergency", "reset"]


def test_who_presses_emergency_again_and_again_does_not_keep_it_from_being_sent(table: Table):
    table.link.held[PRIORITY_EMERGENCY] = threading.Event()
    for _ in range(3):
        table.client.send_mode(["drone1"], "emergency")
    table.link.held[PRIORITY_EMERGENCY].set()
    assert {table.outcome()[:2] for _ in range(3)} == {("drone1: emergency", "")}
    assert table.link.modes == ["emergency"] * 3
