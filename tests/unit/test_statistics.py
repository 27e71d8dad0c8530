"""What a run measures of itself: ages of commands, and the rate of its clock."""

import pytest

from zsim_world.statistics import AGES_KEPT, GATES_KEPT, Ages, Rate

MS = 1_000_000
GATE_NS = 20 * MS


def test_no_command_has_no_age():
    assert Ages().summary_ms() is None


def test_the_age_of_a_command_is_counted_from_the_gate_that_it_answers():
    ages = Ages()
    ages.published(0, 100 * MS)
    ages.published(GATE_NS, 120 * MS)
    ages.arrived(0, 103 * MS)
    ages.arrived(GATE_NS, 121 * MS)
    assert ages.summary_ms() == pytest.approx({"p50": 2.0, "p99": 2.98, "max": 3.0})


def test_percentiles_of_many_ages():
    ages = Ages()
    ages.published(0, 0)
    for age_ms in range(101):
        ages.arrived(0, age_ms * MS)
    assert ages.summary_ms() == pytest.approx({"p50": 50.0, "p99": 99.0, "max": 100.0})


def test_a_command_that_answers_no_gate_has_no_age():
    ages = Ages()
    ages.published(0, 0)
    ages.arrived(7, 5 * MS)
    assert ages.summary_ms() is None


def test_old_gates_and_ages_are_forgotten():
    ages = Ages()
    for gate in range(GATES_KEPT + 1):
        ages.published(gate, gate)
    ages.arrived(0, 10)
    assert ages.summary_ms() is None
    ages.arrived(1, 10)
    assert ages.summary_ms() is not None
    assert ages._ages_ns.maxlen == AGES_KEPT


def test_a_gate_published_twice_is_still_known():
    ages = Ages()
    ages.published(0, 5 * MS)
    ages.published(0, 9 * MS)
    for gate in range(1, 2 * GATES_KEPT):
        ages.published(gate, gate)
    ages.arrived(GATES_KEPT, GATES_KEPT + MS)
    assert ages.summary_ms() == pytest.approx({"p50": 1.0, "p99": 1.0, "max": 1.0})


def test_the_rate_is_simulated_per_wall_time_over_the_last_second():
    rate = Rate()
    assert rate.now() == 0.0
    assert rate.wall_s == 0.0
    rate.gate(0, 7_000 * MS)
    assert rate.now() == 0.0
    for gate in range(1, 101):
        rate.gate(gate * GATE_NS, 7_000 * MS + gate * 5 * MS)
    assert rate.now() == pytest.approx(4.0)
    assert rate.wall_s == pytest.approx(0.5)
    for gate in range(101, 301):
        rate.gate(gate * GATE_NS, 7_500 * MS + (gate - 100) * 10 * MS)
    assert rate.now() == pytest.approx(2.0, rel=0.02)
    assert rate.wall_s == pytest.approx(2.5)


def test_gates_further_apart_than_a_second_still_have_a_rate():
    rate = Rate()
    for gate in range(4):
        rate.gate(gate * GATE_NS, gate * 5_000 * MS)
    assert rate.now() == pytest.approx(0.004)


def test_a_wall_clock_that_stands_gives_no_rate():
    rate = Rate()
    rate.gate(0, 5)
    rate.gate(GATE_NS, 5)
    assert rate.now() == 0.0
