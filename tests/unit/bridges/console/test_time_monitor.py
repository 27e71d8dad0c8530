"""What the console hears of a run: its time, or silence; estimators, alive or dead; faults; what is said of them."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from refused import has_terms, without_tags

from zsim.contract import keys, messages
from zsim.contract.run_messages import Clock, Event, Fault, Faults, Health
from zsim.contract.views import DroneView, EstimateView, ViewDrones, ViewEstimates
from zsim_bridges.console import console_tables
from zsim_bridges.console.console_tables import TableRows, console_state, sigma_m
from zsim_bridges.console.view_buffer import SILENT_S, TimeMonitor, ViewBuffer
from zsim_bridges.observer_process import ObserverProcess

S = 1_000_000_000  # ns
LEVEL = (1.0, 0.0, 0.0, 0.0)
ORIGIN = (0.0, 0.0, 0.0)
UNIT = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)


class Link:
    """A session on which only the test speaks."""

    host = "lab"

    def __init__(self) -> None:
        self.now: Clock | bytes | None = None
        self.asked = 0
        self.say: Callable[[Any], None] = lambda _: None
        self.tell: Callable[[Any], None] = lambda _: None
        self.last: Faults | None = None
        self.meanwhile: Faults | None = None

    def get(self, expression: str, timeout_s: float = 2.0) -> list[Any]:
        if expression == keys.FAULTS:
            if self.meanwhile:
                self.say(sample(keys.FAULTS, self.meanwhile))
            return [sample(keys.FAULTS, self.last)] if self.last else []
        self.asked += 1
        return [] if self.now is None else [sample(keys.CLOCK, self.now)]

    def declare_subscriber(self, expression: str, callback: Callable[[Any], None]) -> None:
        if expression == keys.EVENT:
            self.tell = callback
        else:
            self.say = callback


class Ears:
    """Eyes and a watch on a run of two drones, and a wall clock that only the test moves."""

    def __init__(self, stamp_age_s: float = 0.1) -> None:
        self.wall_s = 100.0
        self.link: Any = Link()
        self.refused: list[Event] = []
        names = ("drone1", "drone2")
        info: Any = SimpleNamespace(run_id="r1", drones=[SimpleNamespace(name=name) for name in names])
        self.observer = ObserverProcess(self.link, info, "console.1")
        self.watch = TimeMonitor(self.link, self.observer, stamp_age_s, lambda: self.wall_s)
        self.views = ViewBuffer(self.link, info, self.observer, {}, self.refused.append, lambda: self.wall_s)
        self.words = TableRows(self.views, {})
        self.views.open()

    def hear(self, *said: tuple[str, Any]) -> None:
        for key, message in said:
            self.link.say(sample(key, message))
        self.views.update()


def sample(key: str, message: Any) -> Any:
    return SimpleNamespace(key=key, payload=message if isinstance(message, bytes) else messages.encode(message))


def clock(t_ns: int, rate: float = 1.0, run_id: str = "r1", state: Any = "running") -> Clock:
    return Clock(t_ns, 0, run_id, 0, state, rate)


def drones(t_ns: int) -> tuple[str, ViewDrones]:
    views = tuple(DroneView(name, ORIGIN, LEVEL, (0.0, 0.0, 0.0, 0.0), "flying", 80.0) for name in ("drone1", "drone2"))
    return keys.VIEW_DRONES, ViewDrones(t_ns, 0, views)


def estimate(t_ns: int, process: str = "estimator.drone1", used: int = 7) -> tuple[str, ViewEstimates]:
    view = EstimateView("drone1", ORIGIN, UNIT, 0.0, 0.1, {"gps": (used, 0)})
    return keys.estimates_view(process), ViewEstimates(t_ns, 0, (view,))


def health(process: str = "estimator.drone1", lag_ns: int = 0) -> tuple[str, Health]:
    return keys.process(process, "health"), Health(0, 0, "estimator", "lab", 1, {}, lag_ns, 0, 0, 0)


# The run's time


def test_a_stamp_is_of_the_present_however_fast_the_run():
    ears = Ears(stamp_age_s=0.1)
    ears.link.now = clock(1 * S, rate=4.0)
    assert ears.watch.now_ns() == 1 * S
    ears.link.now = clock(2 * S, rate=4.0)
    ears.wall_s += 0.02  # 80 ms of the run
    assert ears.watch.now_ns() == 1 * S
    ears.wall_s += 0.01
    assert ears.watch.now_ns() == 2 * S
    assert ears.link.asked == 2


def test_where_no_stamp_is_too_old_nobody_is_asked():
    ears = Ears(stamp_age_s=float("inf"))
    ears.wall_s += 1000.0
    assert ears.watch.now_ns() == 0
    assert ears.link.asked == 0


def test_a_stamp_is_given_also_where_the_world_answers_nothing():
    ears = Ears()
    ears.link.now = clock(1 * S)
    ears.watch.poll()
    ears.link.now = None
    ears.wall_s += 60.0
    assert ears.watch.now_ns() == 1 * S


@pytest.mark.parametrize("garbage", [b"", b"\xc1", b"\x80", messages.encode(drones(0)[1])])
def test_a_foreign_answer_is_no_clock(garbage: bytes):
    ears = Ears()
    ears.link.now = garbage
    ears.watch.poll()
    assert ears.watch.clock is None
    assert ears.observer.health.refused == 1
    ears.link.now = clock(3 * S)
    ears.watch.poll()
    ears.link.now = garbage
    ears.watch.poll()
    assert ears.watch.clock == clock(3 * S)


def test_the_end_of_a_run_is_heard():
    for now, over in ((clock(0, run_id="r2"), "another run"), (clock(0, state="stopped"), "the run ended")):
        ears = Ears()
        ears.link.now = now
        ears.watch.poll()
        assert over in ears.observer.end_reason


def test_silence_of_the_world_is_told_and_for_how_long():
    ears = Ears()
    with ears.watch.polling():
        ears.wall_s += SILENT_S - 0.1
        assert ears.watch.silent_s == 0.0
        ears.wall_s += 10.0
        assert ears.watch.silent_s == pytest.approx(SILENT_S + 9.9)
        ears.link.now = clock(1 * S)
        ears.watch.poll()
        assert ears.watch.silent_s == 0.0
        ears.link.now = None
        ears.watch.poll()
        ears.wall_s += 5.0
        told = console_state("r1", ears.views, ears.watch, {})
        assert told["clock"] == "silent"
        assert told["silent_s"] >= 5.0
    assert ears.watch.silent_s == 0.0  # nobody is asked any more
    assert console_state("r1", ears.views, ears.watch, {})["clock"] == "running"


def test_a_silent_world_is_not_called_running():
    told = console_tables.clock_line(clock(7 * S), 7 * S, 12.3)
    assert has_terms(without_tags(told), "no answer", "12 s")
    assert console_tables.RED in told
    assert "running" not in told


# Estimators


def test_a_dead_estimator_is_not_shown_as_a_healthy_one():
    ears = Ears()
    for second in range(3):
        ears.hear(drones(second * S), estimate(second * S, used=5 * second), health())
        ears.words.sensor_table("drone1")
        ears.wall_s += 1.0
    assert "5 Hz" in ears.words.sensor_table("drone1")
    assert ears.words.drone_rows()[0].lag_ms == 0.0
    ears.wall_s += 8.0
    ears.hear(drones(10 * S))
    assert ears.words.drone_rows()[0].lag_ms == 8000.0
    told = ears.words.sensor_table("drone1")
    assert has_terms(without_tags(told), "no estimate", "2.0 s")
    assert "Hz" not in told
    assert not ears.views.estimates()["drone1"].fresh
    assert console_state("r1", ears.views, ears.watch, {})["drones"][0]["sigma_m"] is None


def test_in_a_fast_run_a_view_may_be_seconds_older_than_another():
    ears = Ears()
    ears.hear(estimate(1 * S), health())
    ears.wall_s += 0.05
    ears.hear(drones(9 * S))
    assert ears.views.estimates()["drone1"].fresh
    assert ears.words.drone_rows()[0].lag_ms == 0.0


def test_in_a_slow_run_a_view_may_be_seconds_old():
    ears = Ears()
    ears.hear(estimate(1 * S))
    ears.wall_s += 9.0
    ears.hear(drones(1 * S + S // 2))
    assert ears.views.estimates()["drone1"].fresh


def test_what_was_believed_before_a_replay_went_back_is_left_out():
    ears = Ears()
    ears.hear(drones(60 * S), estimate(60 * S))
    ears.wall_s += 5.0
    ears.hear(drones(10 * S))
    assert ears.views.estimates() == {}


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_two_estimators_of_one_drone_the_later_is_shown(order: tuple[int, int]):
    ears = Ears()
    said = (estimate(1 * S, "estimator.old", used=1), estimate(2 * S, "estimator.new", used=2))
    ears.hear(drones(2 * S), *(said[i] for i in order), health("estimator.new", 3_000_000), health("estimator.old"))
    assert ears.views.estimates()["drone1"].process == "estimator.new"
    assert ears.words.drone_rows()[0].gps == "2 / 0"
    assert ears.words.drone_rows()[0].lag_ms == 3.0
    assert "<td align=left>2</td>" in ears.words.sensor_table("drone1")


def test_a_covariance_that_is_none_has_no_sigma():
    assert sigma_m(EstimateView("drone1", ORIGIN, (-9.0, 0.0, 0.0, 1.0, 0.0, 1.0), 0.0, 0.1, {})) == 0.0


# Faults and refusals


def test_faults_are_shown_on_a_drone_while_they_act():
    planned = Fault(1, "gps_bias", "drone1", {}, 20 * S)
    acting = Fault(2, "gps_dropout", "drone1", {}, 5 * S, 15 * S)
    ended = Fault(3, "motor", "drone1", {}, 0, 10 * S)
    ears = Ears()
    ears.hear(drones(10 * S), (keys.FAULTS, Faults(0, 0, (planned, acting, ended))))
    assert ears.words.drone_rows()[0].faults == ("gps_dropout",)
    assert ears.words.drone_rows()[1].faults == ()
    told = console_state("r1", ears.views, ears.watch, {})["faults"]
    assert [(fault["from_s"], fault["until_s"]) for fault in told] == [(20.0, None), (5.0, 15.0), (0.0, 10.0)]


def test_faults_that_were_heard_are_not_replaced_by_an_older_answer():
    ears = Ears()
    newer = Fault(2, "gps_dropout", "drone1", {}, 0)
    ears.link.last, ears.link.meanwhile = Faults(0, 0, ()), Faults(0, 1, (newer,))
    ears.views.open()
    ears.views.update()
    assert ears.views.faults == (newer,)


def test_the_console_hears_what_is_refused_of_its_own():
    ears = Ears()
    for kind, source in (("refused", "console.2"), ("command", "console.1"), ("refused", "console.1")):
        event = Event(0, 0, kind, source, "drone/drone1/cmd/mode", "no")
        ears.link.tell(sample(keys.EVENT, event))
    assert [(event.kind, event.source) for event in ears.refused] == [("refused", "console.1")]
    assert ears.views.answered_commands("drone1") == 2
