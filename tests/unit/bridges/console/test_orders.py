"""Orders of operators: carried out once for each id, repeated towards the world until it has confirmed or refused them."""

from collections import Counter
from typing import Any

import pytest
from refused import has_terms

from zsim.contract.run_messages import Event
from zsim_bridges.console.orders import REPEAT_S, SHOWN_S, OrderBook, OrderRequest, RequestOutcome

DRONES = ("drone1", "drone2", "drone3")
S = 1_000_000_000  # ns


class Client:
    """A command client that notes what is sent."""

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
    """An order book of two drones in a formation and one of none; the test is the world."""

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
        """Let an attempt end; return whether operators are told."""
        outcome = RequestOutcome(f"{name}: {op}", refusal, name, op, order=order, unanswered=unanswered)
        return self.book.note(outcome)

    def after(self, seconds: float, *, paused: bool = False, **states: str) -> dict[str, Any]:
        """Let time pass, and views come; return the newest order."""
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
def test_an_order_concerns_whom_it_names_and_is_carried_out_once(
    op: str, of: dict[str, str], sent: list[Any], desk: Desk
):
    for _ in range(5):
        assert desk.place(op, **of)["state"] == "sent"
    assert desk.client.sent == sent


def test_what_has_another_id_is_another_order(desk: Desk):
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
    assert desk.place("emergency")["state"] == "confirmed"  # a page that has not heard of it repeats it still
    assert len(desk.client.sent) == 5
    assert desk.after(SHOWN_S) == {}


def test_one_attempt_at_a_time_is_under_way_and_none_at_a_world_that_is_silent(desk: Desk):
    desk.silent_s = 3.0
    order = desk.place("emergency", drone="drone1")
    assert desk.client.sent == [("drone1", "emergency")]  # at once: it may be heard yet
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


def test_a_stamp_that_grew_old_is_sent_anew_and_what_else_is_refused_is_told(desk: Desk):
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


def test_the_event_of_a_mode_confirms_it_but_of_a_drone_that_the_world_only_hands_it_to(desk: Desk):
    desk.place("land", drone="drone1")
    desk.place("land", "two", drone="drone3")
    desk.happen("mode", "drone1", mode="land")
    desk.happen("mode", "drone3", mode="land")
    rows = {row["id"]: row["state"] for row in desk.book.rows()}
    assert rows == {"one": "confirmed", "two": "sent"}
    assert desk.after(0.1, drone3="landing")["state"] == "confirmed"


def test_what_was_shown_before_an_order_does_not_confirm_it(desk: Desk):
    desk.states["drone1"] = "landing"
    desk.place("land", drone="drone1")
    desk.book.update(desk.states, desk.now_ns, paused=False)
    assert desk.book.rows()[0]["state"] == "sent"


def test_a_paused_run_has_the_order_and_is_not_sent_it_again(desk: Desk):
    desk.place("emergency", drone="drone1")
    desk.end("drone1", "emergency")
    desk.happen("command", "drone1", message={"mode": "emergency"})
    for _ in range(5):
        desk.after(REPEAT_S, paused=True)
    order = desk.after(REPEAT_S, paused=True)
    assert (order["state"], len(desk.client.sent)) == ("sent", 1)
    assert has_terms(order["reason"], "paused")


def test_a_controller_that_answers_confirms_or_refuses_and_one_that_does_not_is_asked_again(desk: Desk):
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


def test_what_a_silent_controller_did_all_the_same_counts(desk: Desk):
    desk.place("hold")
    assert desk.after(0.1, main="held")["state"] == "sent"  # it may be held by a fault
    desk.end("main", "hold", "no answer", unanswered=True)
    desk.after(REPEAT_S, main="engaged")
    assert desk.after(0.1, main="held")["state"] == "confirmed"


def test_a_later_order_replaces_what_it_contradicts_and_never_an_emergency(desk: Desk):
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
def test_what_concerns_nobody_or_another_run_is_refused(request_: OrderRequest, terms: tuple[str, ...], desk: Desk):
    order = desk.book.place(request_)
    assert order["state"] == "refused"
    assert has_terms(order["reason"], *terms)
    assert desk.client.sent == []


def test_a_run_that_is_over_refuses_what_it_has_not_confirmed(desk: Desk):
    desk.place("emergency")
    desk.refusal = "the run is over: 330 s were flown"
    order = desk.after(0.1)
    assert order["state"] == "refused"
    assert has_terms(order["reason"], "330 s")
    assert desk.place("land", "two")["state"] == "refused"
