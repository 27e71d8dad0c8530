"""Simulated time of a run: its states, and the requests that change it."""

import math
from typing import Any

import pytest
from refused import has_terms

from zsim.contract.run_messages import ControlRequest
from zsim.scenario.scenario import TimeSteps
from zsim_world.run.outbox import Refusal
from zsim_world.run.run_clock import RunClock

GATE_NS = 20_000_000


def clock(state: str = "running", mode: str = "lockstep") -> RunClock:
    made = RunClock(TimeSteps(), mode, 0.0)
    made.state = state
    return made


def request(made: RunClock, op: str, **args: Any) -> Any:
    return made.operations()[op](ControlRequest(op, args, "tester.one"))


def test_gates_follow_one_another():
    made = clock("waiting")
    assert (made.now_ns, made.next_ns) == (0, 0)
    made.start(0)
    assert (made.state, made.now_ns, made.next_ns) == ("running", 0, GATE_NS)
    made.advance(GATE_NS)
    assert (made.now_ns, made.next_ns) == (GATE_NS, 2 * GATE_NS)


def test_a_paused_run_goes_on_for_the_steps_that_are_requested():
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
def test_an_operation_is_refused_in_a_state_that_it_does_not_fit(op: str, state: str):
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


def test_of_several_reasons_to_end_the_first_is_kept():
    made = clock()
    request(made, "stop", reason="lunch")
    made.stop("later")
    assert has_terms(made.ended, "tester.one", "lunch")
    assert made.is_halted
