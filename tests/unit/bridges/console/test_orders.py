"""Operators' requests: how orders are repeated until confirmed, and what the command client sends."""

import threading
from collections import Counter
from collections.abc import Iterator
from queue import SimpleQueue
from typing import Any

import pytest
from refused import has_terms

from zsim.contract.run_messages import ControlAnswer, Event
from zsim.errors import SessionError
from zsim_bridges.console.orders import (
    PRIORITY,
    PRIORITY_EMERGENCY,
    REPEAT_S,
    SHOWN_S,
    SUPERSEDED,
    THREADS_PER_POOL,
    CommandClient,
    OrderBook,
    OrderRequest,
    RequestOutcome,
)

DRONES = ("drone1", "drone2", "drone3")
S = 1_000_000_000  # ns


class Client:
    """A command client that records what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str]] = []
        self.modes: Counter[str] = Counter()

    def send_mode(self, drones: list[str], mode: str, order: str = "") -> None:
        for drone in drones:
            self.modes[drone] += 1
            self.sent.append((drone, mode))

    def request_cluster(self, cluster: str, op: str, order: str = "") -> None:
        self.sent.append((cluster, op))

    def modes_requested(self, drone: str) -> int:
        return self.modes[drone]


class Desk:
    """An order book for a formation of two drones and a single drone; the test plays the world."""

    def __init__(self) -> None:
        self.client = Client()
        self.wall_s, self.now_ns, self.silent_s, self.refusal = 100.0, 7 * S, 0.0, ""
        self.states = {"drone1": "flying", "drone2": "flying", "drone3": "flying", "main": "engaged"}
        client: Any = self.client
        self.book = OrderBook(
            client, "r1", {"main": DRONES[:2]}, DRONES, lambda: self.refusal, lambda: self.now_ns,
            lambda: self.silent_s, ("drone3",), lambda: self.wall_s,
        )  # fmt: skip

    def place(self, op: Any, order_id: str = "one", **of: str) -> dict[str, Any]:
        return self.book.place(OrderRequest(op, order_id, **of))

    def end(self, name: str, op: str, refusal: str = "", unanswered: bool = False, order: str = "one") -> bool:
        """End an attempt and return whether operators are notified."""
        outcome = RequestOutcome(f"{name}: {op}", refusal, name, op, order=order, unanswered=unanswered)
        return self.book.note(outcome)

    def after(self, seconds: float, *, paused: bool = False, **states: str) -> dict[str, Any]:
        """Advance the time, deliver new states, and return the newest order."""
        self.wall_s += seconds
        self.now_ns += round(seconds * S)
        self.states |= states
        self.book.update(self.states, self.now_ns, paused=paused)
        rows = self.book.rows()
        return rows[0] if rows else {}

    def happen(self, kind: str, subject: str, **data: Any) -> None:
        self.book.on_event(Event(self.now_ns, 0, kind, "console.1", subject, "", data))


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.mark.parametrize(
    ("op", "of", "sent"),
    [
        ("emergency", {}, [("drone1", "emergency"), ("drone2", "emergency"), ("drone3", "emergency")]),
        ("emergency", {"drone": "drone2"}, [("drone2", "emergency")]),
        ("land", {}, [("main", "land"), ("drone3", "land")]),
        ("land", {"drone": "drone1"}, [("drone1", "land")]),
        ("hold", {}, [("main", "hold")]),
        ("hold", {"cluster": "main"}, [("main", "hold")]),
    ],
)
def test_an_order_goes_once_to_those_it_names(op: str, of: dict[str, str], sent: list[Any], desk: Desk):
    for _ in range(5):
        assert desk.place(op, **of)["state"] == "sent"
    assert desk.client.sent == sent


def test_an_order_with_another_id_is_a_new_order(desk: Desk):
    desk.place("emergency", drone="drone1")
    desk.place("emergency", "two", drone="drone1")
    desk.place("emergency", "", drone="drone1")
    desk.place("emergency", "", drone="drone1")
    assert len(desk.client.sent) == 4


def test_an_emergency_is_repeated_until_every_drone_has_stopped(desk: Desk):
    desk.place("emergency")
    for name in DRONES:
        desk.end(name, "emergency")
    order = desk.after(REPEAT_S / 2, drone1="emergency")
    assert (order["state"], order["waiting"]) == ("sent", ["drone2", "drone3"])
    assert len(desk.client.sent) == 3
    desk.after(REPEAT_S / 2)
    assert desk.client.sent[3:] == [("drone2", "emergency"), ("drone3", "emergency")]
    order = desk.after(0.1, drone2="emergency", drone3="emergency")
    assert (order["state"], order["t_s"]) == ("confirmed", desk.now_ns / 1e9)
    desk.after(10 * REPEAT_S)
    assert len(desk.client.sent) == 5
    assert desk.place("emergency")["state"] == "confirmed"  # a page that missed the confirmation repeats it
    assert len(desk.client.sent) == 5
    assert desk.after(SHOWN_S) == {}


def test_one_attempt_is_made_at_a_time_and_no_repetition_in_silence(desk: Desk):
    desk.silent_s = 3.0
    order = desk.place("emergency", drone="drone1")
    assert desk.client.sent == [("drone1", "emergency")]  # at once: the world may still receive it
    assert has_terms(order["reason"], "world", "3 s")
    desk.after(5.0)
    desk.end("drone1", "emergency", "no answer came", unanswered=True)
    desk.after(5.0)
    assert len(desk.client.sent) == 1
    desk.silent_s = 0.0
    assert desk.after(0.1)["state"] == "sent"
    assert len(desk.client.sent) == 2
    desk.after(5.0)
    assert len(desk.client.sent) == 2


def test_an_order_refused_for_its_age_is_repeated_others_are_refused(desk: Desk):
    desk.place("emergency", drone="drone1")
    desk.end("drone1", "emergency")
    desk.happen("refused", "drone/drone1/cmd/mode", reason="age is 12000 ms; must be <= 200 ms")
    assert desk.after(REPEAT_S)["state"] == "sent"
    assert len(desk.client.sent) == 2
    desk.end("drone1", "emergency")
    desk.happen("refused", "drone/drone1/cmd/mode", reason="drone1 is flown by 'console.2' (priority 100)")
    order = desk.after(REPEAT_S)
    assert order["state"] == "refused"
    assert has_terms(order["reason"], "drone1", "'console.2'")
    assert len(desk.client.sent) == 2


def test_a_mode_event_confirms_an_order_except_for_external_drones(desk: Desk):
    desk.place("land", drone="drone1")
    desk.place("land", "two", drone="drone3")
    desk.happen("mode", "drone1", mode="land")
    desk.happen("mode", "drone3", mode="land")
    rows = {row["id"]: row["state"] for row in desk.book.rows()}
    assert rows == {"one": "confirmed", "two": "sent"}
    assert desk.after(0.1, drone3="landing")["state"] == "confirmed"


def test_a_state_from_before_an_order_does_not_confirm_it(desk: Desk):
    desk.states["drone1"] = "landing"
    desk.place("land", drone="drone1")
    desk.book.update(desk.states, desk.now_ns, paused=False)
    assert desk.book.rows()[0]["state"] == "sent"


def test_an_order_that_a_paused_run_has_received_is_not_repeated(desk: Desk):
    desk.place("emergency", drone="drone1")
    desk.end("drone1", "emergency")
    desk.happen("command", "drone1", message={"mode": "emergency"})
    for _ in range(5):
        desk.after(REPEAT_S, paused=True)
    order = desk.after(REPEAT_S, paused=True)
    assert (order["state"], len(desk.client.sent)) == ("sent", 1)
    assert has_terms(order["reason"], "paused")


def test_an_unanswered_request_to_a_controller_is_repeated(desk: Desk):
    desk.place("hold")
    told = desk.end("main", "hold", "no answer came within 5 s", unanswered=True)
    assert not told
    order = desk.after(REPEAT_S)
    assert (order["state"], len(desk.client.sent)) == ("sent", 2)
    assert has_terms(order["reason"], "main", "no answer")
    assert desk.end("main", "hold")
    assert desk.after(0.1)["state"] == "confirmed"
    desk.place("land", "two")
    told = desk.end("main", "land", "all drones are on the ground", order="two")
    assert told
    desk.happen("mode", "drone3", mode="land")
    order = desk.after(0.1, drone3="landing")
    assert order["state"] == "refused"
    assert has_terms(order["reason"], "main", "ground")


def test_the_state_confirms_an_order_whose_answer_was_lost(desk: Desk):
    desk.place("hold")
    assert desk.after(0.1, main="held")["state"] == "sent"  # a fault may be holding it
    desk.end("main", "hold", "no answer", unanswered=True)
    desk.after(REPEAT_S, main="engaged")
    assert desk.after(0.1, main="held")["state"] == "confirmed"


def test_a_later_order_replaces_earlier_ones_but_never_an_emergency(desk: Desk):
    desk.place("hold")
    desk.place("land", "two")
    desk.place("emergency", "three")
    rows = {row["id"]: row["state"] for row in desk.book.rows()}
    assert rows == {"one": "replaced", "two": "replaced", "three": "sent"}
    desk.place("land", "four", drone="drone1")
    assert {row["id"]: row["state"] for row in desk.book.rows()}["three"] == "sent"


def test_a_reset_ends_the_repetition_of_an_emergency(desk: Desk):
    desk.place("emergency", drone="drone1")
    desk.end("drone1", "emergency")
    desk.client.send_mode(["drone1"], "reset")
    assert desk.after(REPEAT_S)["state"] == "replaced"
    assert desk.client.sent == [("drone1", "emergency"), ("drone1", "reset")]


@pytest.mark.parametrize(
    ("request_", "terms"),
    [
        (OrderRequest("emergency", run="r0"), ("another run",)),
        (OrderRequest("land", drone="drone9"), ("'drone9'",)),
        (OrderRequest("hold", cluster="nobody"), ("'nobody'",)),
    ],
)
def test_an_order_for_an_unknown_subject_or_another_run_is_refused(
    request_: OrderRequest, terms: tuple[str, ...], desk: Desk
):
    order = desk.book.place(request_)
    assert order["state"] == "refused"
    assert has_terms(order["reason"], *terms)
    assert desk.client.sent == []


def test_the_end_of_a_run_refuses_unconfirmed_orders(desk: Desk):
    desk.place("emergency")
    desk.refusal = "the run is over: 330 s were flown"
    order = desk.after(0.1)
    assert order["state"] == "refused"
    assert has_terms(order["reason"], "330 s")
    assert desk.place("land", "two")["state"] == "refused"


PATIENCE_S = 120.0


class Link:
    """A session that records the requests."""

    def __init__(self) -> None:
        self.sent: list[tuple[Any, ...]] = []
        self.refusals: dict[str, str] = {}
        self.given_back = threading.Event()
        self.answers = threading.Event()  # set to answer the requests that hang
        self.held: dict[int, threading.Event] = {}  # by priority: set to answer an acquire
        self.acquiring: SimpleQueue[int] = SimpleQueue()

    @property
    def modes(self) -> list[str]:
        """The modes sent, in order."""
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
    """Behaves as if every command were answered at once."""

    def answered_commands(self, drone: str) -> int:
        return 0

    def await_answer(self, drone: str, beyond: int, within_s: float) -> None:
        return


class Table:
    """A command client with its session and the outcomes that it reports."""

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


def test_a_request_is_sent_in_the_name_of_the_console(table: Table):
    table.client.request_cluster("main", "target", values={"p": 4.0}, over_s=5.0)
    outcome = table.outcome()
    assert has_terms(outcome.request, "main", "target", "p=4", "over_s 5")
    assert outcome.refusal == ""
    args = {"values": {"p": 4.0}, "over_s": 5.0}
    assert table.link.sent == [("cluster/main/control", "target", "console.1", args)]


def test_waypoints_are_described_by_their_number(table: Table):
    points = [{"at_s": 10.0 * k, "values": {"x_c": 5.0}} for k in range(3)]
    table.client.request_cluster("main", "trajectory", waypoints=points)
    assert has_terms(table.outcome().request, "main", "waypoints (3)")
    table.client.request_world("fault_add", kind="gust", velocity_m_s=[4.0, 0.0, -1.5])
    assert has_terms(table.outcome().request, "gust", "velocity_m_s 4 0 -1.5")


@pytest.mark.parametrize(
    ("op", "terms"),
    [("pause", ("not now",)), ("broken", ("session", "closed")), ("wrong", ("ValueError", "no such thing"))],
)
def test_a_refusal_or_an_error_is_reported(table: Table, op: str, terms: tuple[str, ...]):
    table.link.refusals["pause"] = "not now"
    table.client.request_world(op)
    outcome = table.outcome()
    assert outcome.request == op
    assert has_terms(outcome.refusal, *terms)


def test_requests_after_the_end_of_the_run_are_refused(table: Table):
    table.client.close()
    table.client.request_world("pause")
    table.client.send_mode(["drone1"], "land")
    outcomes = [table.outcome() for _ in range(2)]
    assert [outcome.request for outcome in outcomes] == ["pause", "drone1: land"]
    assert all(has_terms(outcome.refusal, "run", "ended") for outcome in outcomes)
    assert table.link.sent == []


def test_a_drone_is_acquired_commanded_and_released(table: Table):
    table.client.send_mode(["drone1"], "land")
    assert table.outcome()[:2] == ("drone1: land", "")
    assert table.link.given_back.wait(PATIENCE_S)
    acquire, (key, mode), release = table.link.sent
    assert acquire == ("world/control", "acquire", "console.1", {"drone": "drone1", "priority": PRIORITY})
    assert (key, mode.mode, mode.source, mode.t_ns, mode.seq) == ("drone/drone1/cmd/mode", "land", "console.1", 7, 0)
    assert release == ("world/control", "release", "console.1", {"drone": "drone1"})


def test_a_drone_of_another_operator_is_not_commanded(table: Table):
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


def test_an_emergency_is_sent_even_if_the_drone_is_refused(table: Table):
    table.link.refusals["acquire"] = "drone1 is flown by 'console.2' with priority 100"
    table.client.send_mode(["drone1"], "emergency")
    assert has_terms(table.outcome().refusal, "drone1", "'console.2'", "100", "emergency")
    args = {"drone": "drone1", "priority": PRIORITY_EMERGENCY}
    assert table.link.sent[0] == ("world/control", "acquire", "console.1", args)
    assert table.link.modes == ["emergency"]


def test_an_emergency_does_not_wait_for_unanswered_requests(table: Table):
    for _ in range(3 * THREADS_PER_POOL):
        table.client.request_cluster("main", "hangs")
    table.client.send_mode(["drone1"], "emergency")
    assert table.outcome()[:2] == ("drone1: emergency", "")
    assert not table.link.answers.is_set()
    table.link.answers.set()


def test_an_emergency_does_not_wait_for_pending_releases(table: Table):
    answered = threading.Event()
    table.views.await_answer = lambda *_: answered.wait(PATIENCE_S)  # type: ignore[method-assign, assignment]
    names = [f"drone{i}" for i in range(3 * THREADS_PER_POOL)]
    table.client.send_mode(names, "land")
    assert {table.outcome().request for _ in names} == {f"{name}: land" for name in names}
    table.client.send_mode(names, "emergency")
    assert {table.outcome().request for _ in names} == {f"{name}: emergency" for name in names}
    answered.set()


def test_modes_of_one_drone_are_sent_in_the_order_of_the_clicks(table: Table):
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


def test_nothing_requested_before_an_emergency_is_sent_after_it(table: Table):
    table.link.held[PRIORITY] = threading.Event()
    table.client.send_mode(["drone1"], "takeoff")
    assert table.link.acquiring.get(timeout=PATIENCE_S) == PRIORITY
    table.client.send_mode(["drone1"], "land")
    table.client.send_mode(["drone1"], "emergency")
    assert table.outcome()[:2] == ("drone1: emergency", "")
    table.link.held[PRIORITY].set()
    assert table.outcome()[:2] == ("drone1: takeoff", SUPERSEDED)
    assert table.outcome()[:2] == ("drone1: land", SUPERSEDED)
    assert table.link.modes == ["emergency"]


def test_a_reset_is_sent_after_the_emergency_that_it_ends(table: Table):
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


def test_pressing_emergency_repeatedly_does_not_delay_it(table: Table):
    table.link.held[PRIORITY_EMERGENCY] = threading.Event()
    for _ in range(3):
        table.client.send_mode(["drone1"], "emergency")
    table.link.held[PRIORITY_EMERGENCY].set()
    assert {table.outcome()[:2] for _ in range(3)} == {("drone1: emergency", "")}
    assert table.link.modes == ["emergency"] * 3
