"""What a page does with the time of a replay."""

from types import SimpleNamespace
from typing import Any

import pytest

from zsim_bridges.console.run_condition import RunCondition
from zsim_bridges.console.time_monitor import RecordPlayer

TIMELINE = {"from_s": 0.0, "to_s": 9.0, "marks": []}


def player(state: str, is_replay: bool = True) -> tuple[RecordPlayer, list[Any]]:
    """Return a player that has loaded its timeline, and what it requests."""
    asked: list[Any] = []
    client: Any = SimpleNamespace(
        timeline=lambda: TIMELINE,
        seek=lambda t_s, step: asked.append(("seek", t_s, step)),
        request_world=lambda op, **args: asked.append((op, args)),
    )
    monitor: Any = SimpleNamespace(clock=None)
    monitor.poll = lambda: setattr(monitor, "clock", SimpleNamespace(state=state, t_ns=8 * 10**9))
    made = RecordPlayer(client, monitor, is_replay)
    made.load()
    return made, asked


@pytest.mark.parametrize(
    ("op", "value", "request_"),
    [
        ("pause", 1.0, ("pause", {})),
        ("resume", 1.0, ("resume", {})),
        ("step", 1.0, ("step", {"gates": 1})),
        ("rate", 0.5, ("rate", {"value": 0.5})),
        ("seek", 4.0, ("seek", 4.0, False)),
    ],
)
def test_a_replay_is_asked_for_it(op: str, value: float, request_: Any):
    made, asked = player("running")
    made.play(op, value)
    assert asked == [request_]


def test_a_replay_that_stands_shows_where_it_was_put():
    made, asked = player("paused")
    made.play("seek", 4.0)
    assert asked[1:] == [("seek", 4.0, True)]


def test_of_a_replay_that_stands_the_last_instant_is_asked_for_again():
    _, asked = player("paused")
    assert asked == [("seek", 8.0, True)]
    for state in ("running", "stopped"):
        assert player(state)[1] == []


@pytest.mark.parametrize(
    ("run", "refused"),
    [
        (RunCondition("running", replayed=True), {"resume", "step"}),
        (RunCondition("paused", replayed=True), {"pause"}),
        (RunCondition("paused", replayed=True, at_end=True), {"pause", "resume", "step"}),
        (
            RunCondition("stopped", replayed=True, ended="the record is over"),
            {"pause", "resume", "step", "rate", "seek"},
        ),
    ],
)
def test_the_timeline_has_what_would_be_refused(run: RunCondition, refused: set[str]):
    made, _ = player("paused")
    refusals = made.state(run)["refusals"]
    assert {op for op, reason in refusals.items() if reason} == refused


def test_a_record_is_read_around_the_shown_instant_the_nearest_first():
    asked: list[tuple[float, float]] = []
    tasks: list[Any] = []
    client: Any = SimpleNamespace(
        timeline=lambda: {"from_s": 0.0, "to_s": 1000.0},
        past_views=lambda from_s, to_s, every_s: asked.append((from_s, to_s)) or [(from_s, to_s)],
        read=lambda act: tasks.append(act) or True,
    )
    monitor: Any = SimpleNamespace(clock=None, poll=lambda: None)
    made = RecordPlayer(client, monitor, True)
    made.load()

    def read(t_s: float) -> list[float]:
        asked.clear()
        made.fill(t_s)
        made.fill(t_s)  # it is read once at a time
        while tasks:
            tasks.pop()()
        return [from_s for from_s, _ in asked]

    begun = read(505.0)
    assert begun[0] == 500.0
    assert set(begun[1:3]) == {490.0, 510.0}
    assert (min(begun), max(begun)) == (320.0, 590.0)
    assert read(505.0) == []
    assert read(515.0) == [600.0]
    assert read(5.0)[0] == 0.0
    assert read(505.0)[0] == 500.0  # it was forgotten, so far away
    assert made.take() == [(500.0, 509.875)]


def test_a_flight_has_no_timeline():
    made, asked = player("running", is_replay=False)
    made.play("pause", 1.0)
    assert made.timeline == made.state(RunCondition("running")) == {}
    assert asked == []
