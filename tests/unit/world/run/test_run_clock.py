"""The clock of a run: its states, the requests that change it, and the statistics of a run."""

import math
from typing import Any

import pytest
from refused import has_terms

from zsim.contract.run_messages import ControlRequest
from zsim.scenario.scenario import TimeSteps
from zsim_world.run.outbox import Refusal
from zsim_world.run.run_clock import GATES_KEPT, CommandAges, RealTimeFactor, RunClock, RunStatistics

GATE_NS = 20_000_000


def clock(state: str = "running", mode: str = "lockstep") -> RunClock:
    made = RunClock(TimeSteps(), mode, 0.0)
    made.state = state
    return made


def request(made: RunClock, op: str, **args: Any) -> Any:
    return made.operations()[op](ControlRequest(op, args, "tester.one"))


def test_the_clock_advances_gate_by_gate():
    made = clock("waiting")
    assert (made.now_ns, made.next_ns) == (0, 0)
    made.start(0)
    assert (made.state, made.now_ns, made.next_ns) == ("running", 0, GATE_NS)
    made.advance(GATE_NS)
    assert (made.now_ns, made.next_ns) == (GATE_NS, 2 * GATE_NS)


def test_a_paused_run_advances_by_the_requested_steps():
    made = clock()
    assert request(made, "pause") is None
    assert made.is_halted
    assert request(made, "step", gates=2.0) is None
    for _ in range(2):
        assert not made.is_halted
        made.advance(made.next_ns)
    assert made.is_halted
    assert request(made, "resume") is None
    assert not made.is_halted


@pytest.mark.parametrize("gates", [0, 1.5, -1, 10**7, math.nan, math.inf, "2", True, None])
def test_a_step_takes_a_whole_number_of_gates(gates: Any):
    refusal = request(clock("paused"), "step", gates=gates)
    assert refusal[:2] == ("gates", repr(gates))


@pytest.mark.parametrize(("op", "state"), [("pause", "paused"), ("resume", "running"), ("step", "waiting")])
def test_an_operation_is_refused_in_an_unsuitable_state(op: str, state: str):
    refusal = request(clock(state), op)
    assert isinstance(refusal, Refusal)
    assert refusal[:2] == ("the run", state)


@pytest.mark.parametrize(
    ("mode", "rate", "taken"),
    [("lockstep", 0, True), ("realtime", 0, False), ("realtime", 2, True), ("lockstep", -1, False), ("lockstep", math.inf, False)],
)  # fmt: skip
def test_a_rate_is_set_within_its_limits(mode: str, rate: float, taken: bool):
    made = clock(mode=mode)
    made.rate = 1.0
    refusal = request(made, "rate", value=rate)
    assert (refusal is None) == taken
    assert made.rate == (rate if taken else 1.0)


def test_only_the_first_of_several_reasons_to_end_is_kept():
    made = clock()
    request(made, "stop", reason="lunch")
    made.stop("later")
    assert has_terms(made.ended, "tester.one", "lunch")
    assert made.is_halted


MS = 1_000_000


@pytest.mark.parametrize(
    ("gates", "commands", "summary"),
    [
        ([], [], None),
        ([(0, 0)], [(7, 5)], None),
        ([(0, 100), (GATE_NS, 120)], [(0, 103), (GATE_NS, 121)], (2.0, 2.98, 3.0)),
        ([(0, 0)], [(0, age_ms) for age_ms in range(101)], (50.0, 99.0, 100.0)),
        ([(gate, gate) for gate in range(GATES_KEPT + 1)], [(0, 10)], None),
        ([(gate, gate) for gate in range(GATES_KEPT + 1)], [(1, 11)], (10.0, 10.0, 10.0)),
        ([(0, 5), (0, 9), *((g, g) for g in range(1, 2 * GATES_KEPT))], [(GATES_KEPT, GATES_KEPT + 1)], (1.0,) * 3),
    ],
    ids=["none", "of no gate", "of two gates", "many", "of a forgotten gate", "of the oldest", "published twice"],
)
def test_the_age_of_a_command_is_counted_from_the_gate_that_it_answers(
    gates: list[tuple[int, int]], commands: list[tuple[int, int]], summary: tuple[float, ...] | None
):
    ages = CommandAges()
    for t_ns, wall_ms in gates:
        ages.gate(t_ns, wall_ms * MS)
    for t_ns, wall_ms in commands:
        ages.command(t_ns, wall_ms * MS)
    wanted = summary and dict(zip(("p50", "p99", "max"), summary, strict=True))
    assert ages.summary_ms() == (pytest.approx(wanted) if wanted else None)


def test_old_ages_are_forgotten(monkeypatch):
    monkeypatch.setattr("zsim_world.run.run_clock.AGES_KEPT", 2)
    ages = CommandAges()
    ages.gate(0, 0)
    for age_ms in (9, 8, 3, 2, 1):
        ages.command(0, age_ms * MS)
    assert ages.summary_ms() == pytest.approx({"p50": 1.5, "p99": 1.99, "max": 2.0})


def test_the_rate_is_simulated_time_per_wall_time_over_the_last_second():
    rate = RealTimeFactor()
    assert (rate.now(), rate.wall_s) == (0.0, 0.0)
    rate.gate(0, 7_000 * MS)
    assert rate.now() == 0.0
    for gate in range(1, 101):
        rate.gate(gate * GATE_NS, 7_000 * MS + gate * 5 * MS)
    assert (rate.now(), rate.wall_s) == pytest.approx((4.0, 0.5))
    for gate in range(101, 301):
        rate.gate(gate * GATE_NS, 7_500 * MS + (gate - 100) * 10 * MS)
    assert rate.now() == pytest.approx(2.0, rel=0.02)
    assert rate.wall_s == pytest.approx(2.5)


@pytest.mark.parametrize(
    ("wall_ms", "now"), [([0, 5_000, 10_000, 15_000], 0.004), ([5, 5], 0.0)], ids=["rare gates", "a standing clock"]
)
def test_the_rate_is_defined_for_rare_gates_and_a_stopped_wall_clock(wall_ms: list[int], now: float):
    rate = RealTimeFactor()
    for gate, wall in enumerate(wall_ms):
        rate.gate(gate * GATE_NS, wall * MS)
    assert rate.now() == pytest.approx(now)


def test_a_jump_in_simulated_time_does_not_count_as_elapsed():
    """Five seconds from 300 s at twice real time, then a jump back to 1 s and four more seconds."""
    rate = RealTimeFactor()
    for number in range(11):
        if number == 6:
            rate.jump()
        t_s = 300 + number if number < 6 else number - 5
        rate.gate(t_s * 1_000 * MS, number * 500 * MS)
        assert rate.now() == pytest.approx(0.0 if number in (0, 6) else 2.0)
    assert (rate.sim_ns / 1e9, rate.wall_s) == pytest.approx((9.0, 5.0))


def test_the_wall_time_of_a_standstill_is_excluded_from_the_rate():
    rate = RealTimeFactor()
    rate.gate(0, 0)
    rate.gate(GATE_NS, 20 * MS)
    rate.stand_still(5_000 * MS)
    rate.gate(2 * GATE_NS, 5_010 * MS)
    assert (rate.sim_ns, rate.wall_s, rate.now()) == (2 * GATE_NS, pytest.approx(0.03), pytest.approx(2.0))


class Owing:
    """A participant that owes its dones up to a gate."""

    def __init__(self, name: str, owes_until_ns: int) -> None:
        self.name, self.gating, self.deadline_misses = name, True, 0
        self._owes_until_ns = owes_until_ns

    def required_ns(self, need_ns: int) -> int | None:
        return need_ns if need_ns >= 0 else None

    def blocks(self, need_ns: int) -> bool:
        return need_ns < self._owes_until_ns


def test_the_result_has_deadline_misses_rate_and_shortest_distance():
    measured = RunStatistics()
    both: list[Any] = [Owing("late", 2), Owing("quick", 0)]
    for need_ns in (-1, 0, 1, 2):
        measured.deadlines(both, need_ns)
    measured.world_misses += 1
    for t_ns, wall_ns in ((0, 0), (2_000_000_000, 500_000_000)):
        measured.gate(t_ns, wall_ns)
    result = measured.result(both)
    assert (result["real_time_factor"], result["deadlines"], result["deadline_misses"]) == (4.0, 6, 3)
    assert result["deadline_misses_by"] == {"late": 2, "quick": 0, "world": 1}
    assert result["closest_m"] is None
    measured.closest_m = 0.5
    assert measured.result(both)["closest_m"] == 0.5
