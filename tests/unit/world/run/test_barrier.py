"""The barrier: which processes are waited for, since when, and what a join, a done, a death or a bye changes."""

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsim.contract.run_messages import Done, Join, Waiting
from zsim_world.run.barrier import Barrier

RUN = "run1"
GATE_NS = 20_000_000
WALL_NS = 5_000_000_000


def join(incarnation: int = 1, period_ns: int = GATE_NS, run_id: str = RUN, host: str = "laptop", **more: Any) -> Join:
    bare = Join(0, 0, run_id, incarnation, "estimator", host, 42, period_ns, "0.1.0", "f00d")
    return msgspec.structs.replace(bare, **more)


def done(gate: int, sent: int = 0, incarnation: int = 1, run_id: str = RUN, seq: int | None = None) -> Done:
    return Done(gate * GATE_NS, gate if seq is None else seq, run_id, incarnation, gate * GATE_NS, sent)


def barrier(*names: str, expected: list[str] | None = None, **of: Any) -> Barrier:
    made = Barrier(RUN, GATE_NS, list(names) if expected is None else expected)
    for name in names:
        assert made.join(name, join(**of), 0, 0) is None
    return made


def blocked(made: Barrier, gate: int) -> list[str]:
    return [participant.name for participant in made.blocking(gate * GATE_NS)]


def incomplete(made: Barrier) -> list[str]:
    return [participant.name for participant in made.incomplete()]


# Participants


def test_the_run_waits_for_every_expected_process():
    made = Barrier(RUN, GATE_NS, ["estimator.d1", "controller.main"])
    made.join("controller.main", join(), 0, 0)
    made.expect("console.1")
    assert made.absent() == ["estimator.d1", "console.1"]
    made.join("estimator.d1", join(), 0, 0)
    made.join("console.1", join(period_ns=0), 0, 0)
    assert made.absent() == []


def test_one_process_may_stand_in_for_several_expected_ones():
    made = Barrier(RUN, GATE_NS, ["estimator.d1", "estimator.d2", "controller.main"])
    made.join("controller.main", join(serves=("estimator.d1", "estimator.d2")), 0, 0)
    assert (made.absent(), blocked(made, 0)) == ([], ["controller.main"])
    made.remove("controller.main")
    assert made.absent() == []
    made.expect("estimator.d2")
    assert made.absent() == ["estimator.d2"]


def test_a_substitute_replaces_dead_processes_and_continues_from_them():
    made = barrier("estimator.d2", "controller.main", "estimator.d3")
    for name, gate in (("estimator.d2", 7), ("controller.main", 5), ("estimator.d3", 6)):
        made.done(name, done(gate), 9 * GATE_NS, 0)
    made.mark_dead("estimator.d2", WALL_NS)
    made.mark_dead("controller.main", WALL_NS)
    made.join("controller.main", join(2, serves=("estimator.d1", "estimator.d2")), 10 * GATE_NS, WALL_NS)
    assert list(made.participants) == ["controller.main", "estimator.d3"]
    joined = made.participants["controller.main"]
    assert (joined.from_ns, joined.done_ns) == (0, 5 * GATE_NS)


def test_a_repeated_join_changes_nothing_but_a_new_process_replaces():
    made = barrier("estimator.d1")
    first = made.participants["estimator.d1"]
    first.away = True
    assert not made.would_replace("estimator.d1", join())
    assert made.join("estimator.d1", join(), 10 * GATE_NS, WALL_NS) is None
    assert made.participants["estimator.d1"] is first
    assert (first.away, first.rejoined) == (False, False)

    assert made.would_replace("estimator.d1", join(2, pid=43))
    assert not made.would_replace("estimator.d1", join(2, pid=43, run_id="run2"))
    assert not made.would_replace("estimator.d2", join(2, pid=43))
    assert made.join("estimator.d1", join(2), 10 * GATE_NS, WALL_NS) is None
    assert made.participants["estimator.d1"].rejoined


def test_a_process_that_lives_or_does_more_is_not_replaced():
    made = barrier("estimator.d1")
    made.join("estimator.d3", join(serves=("estimator.d2",)), 0, 0)
    made.mark_dead("estimator.d3", WALL_NS)
    made.join("controller.main", join(serves=("estimator.d1", "estimator.d3")), 0, 0)
    assert list(made.participants) == ["estimator.d1", "estimator.d3", "controller.main"]


def test_work_done_by_two_processes_is_detected():
    made = barrier("estimator.d2")
    made.join("controller.main", join(serves=("estimator.d1", "estimator.d2")), 0, 0)
    assert made.duplicates("controller.main") == {"estimator.d2": {"estimator.d2"}}
    assert made.duplicates("estimator.d2") == {"controller.main": {"estimator.d2"}}
    assert made.substitute("estimator.d2") is made.participants["controller.main"]
    assert made.substitute("controller.main") is None
    made.mark_dead("controller.main", WALL_NS)
    assert (made.duplicates("estimator.d2"), made.substitute("estimator.d2")) == ({}, None)


def test_two_processes_that_serve_each_other_are_substitutes():
    made = barrier()
    for name, other in (("group.a", "group.b"), ("group.b", "group.a")):
        made.join(name, join(serves=(other,)), 0, 0)
    assert made.substitute("group.a") is made.participants["group.b"]


def test_every_participant_owes_a_done_for_the_instant_of_the_commands():
    made = barrier("a", "b")
    assert (blocked(made, -1), blocked(made, 0)) == ([], ["a", "b"])  # before the first gate, and after it
    for name, others in (("a", ["b"]), ("b", [])):
        assert made.done(name, done(0), 0, WALL_NS) is None
        assert blocked(made, 0) == others
    assert blocked(made, 1) == ["a", "b"]


def test_a_participant_that_does_not_gate_is_never_waited_for():
    made = barrier("recorder", period_ns=0)
    assert blocked(made, 1000) == []
    assert not made.is_gating("recorder")


def test_a_participant_with_slack_is_awaited_only_beyond_it():
    made = barrier("recorder", period_ns=0, slack_ns=10 * GATE_NS)
    assert not made.is_gating("recorder")
    made.done("recorder", done(5), 15 * GATE_NS, 0)
    assert (blocked(made, 15), blocked(made, 16)) == ([], ["recorder"])
    made.done("recorder", done(9, seq=7), 16 * GATE_NS, 0)  # it sends a done only now and then, so a gap is no loss
    assert blocked(made, 16) == made.incomplete() == []


def test_a_restarted_participant_with_slack_continues_from_its_predecessor():
    made = barrier("recorder", period_ns=0, slack_ns=10 * GATE_NS)
    made.done("recorder", done(5), 8 * GATE_NS, 0)
    made.mark_dead("recorder", WALL_NS)
    made.join("recorder", join(2, period_ns=0, slack_ns=10 * GATE_NS), 15 * GATE_NS, WALL_NS)
    assert (blocked(made, 15), blocked(made, 16)) == ([], ["recorder"])


@pytest.mark.parametrize(("period", "need", "owed"), [(5, 4, 0), (5, 5, 5), (5, 9, 5), (2, 7, 6), (1, 7, 7)])
def test_a_participant_owes_dones_only_at_its_own_period(period: int, need: int, owed: int):
    made = barrier("a", period_ns=period * GATE_NS)
    if owed:
        made.done("a", done(owed - period, seq=0), need * GATE_NS, 0)
        assert blocked(made, need) == ["a"]
    made.done("a", done(owed, seq=1), need * GATE_NS, 0)
    assert blocked(made, need) == []


@pytest.mark.parametrize(("period", "first"), [(1, 7), (5, 10)])
def test_a_late_joiner_is_waited_for_from_its_own_first_instant(period: int, first: int):
    made = barrier(expected=[])
    made.join("late", join(period_ns=period * GATE_NS), 7 * GATE_NS, 0)
    assert [gate for gate in range(13) if blocked(made, gate)] == [*range(first, 13)]


@pytest.mark.parametrize(
    ("name", "message", "where", "found"),
    [
        ("a", join(run_id="run0"), "run_id", "'run0'"),
        ("a", join(period_ns=-GATE_NS), "period_ns", "-20000000"),
        ("a", join(period_ns=GATE_NS + 1), "period_ns", "20000001"),
        ("world", join(), "name", "'world'"),
        ("A", join(), "name", "'A'"),
        ("", join(), "name", "''"),
        ("x" * 49, join(), "name", f"'{'x' * 49}'"),
        ("a\nb", join(), "name", "'a\\nb'"),
    ],
)
def test_an_invalid_join_is_refused_with_the_reason(name: str, message: Join, where: str, found: str):
    made = barrier("b")
    refusal = made.join(name, message, 0, 0)
    assert refusal is not None
    assert refusal[:2] == (where, found)
    assert len(str(refusal).splitlines()) == 1
    assert list(made.participants) == ["b"]


# Incarnations


def test_a_new_incarnation_continues_from_its_predecessor():
    made = barrier("a")
    made.done("a", done(3), 3 * GATE_NS, 0)
    made.participants["a"].deadline_misses = 7
    made.mark_dead("a", WALL_NS)
    assert made.join("a", join(2, host="other"), 50 * GATE_NS, WALL_NS) is None
    again = made.participants["a"]
    assert (again.alive, again.join.host, again.deadline_misses) == (True, "other", 7)
    assert (blocked(made, 3), blocked(made, 4)) == ([], ["a"])
    assert made.done("a", done(4, incarnation=2), 5 * GATE_NS, 0) is None
    assert blocked(made, 4) == []


def test_a_repeated_join_keeps_the_output_counts_and_the_first_gate():
    made = barrier("a")
    made.count_output("a")
    made.join("a", join(1), 9 * GATE_NS, WALL_NS)
    made.done("a", done(0, sent=1), 0, 0)
    assert (blocked(made, 0), made.participants["a"].from_ns) == ([], 0)


def test_a_watcher_that_begins_to_gate_is_waited_for_from_then_on():
    made = barrier("a", period_ns=0)
    made.join("a", join(2), 8 * GATE_NS, 0)
    assert (blocked(made, 7), blocked(made, 8)) == ([], ["a"])


def test_a_rejoin_resets_the_output_counts():
    made = barrier("a")
    made.done("a", done(0, sent=3), 0, 0)
    assert incomplete(made) == ["a"]
    made.join("a", join(2), GATE_NS, 0)
    assert incomplete(made) == []


# Dones, and the outputs that they count


def test_an_older_done_never_moves_a_participant_back():
    made = barrier("a")
    made.done("a", done(5), 9 * GATE_NS, WALL_NS)
    assert made.done("a", done(3), 9 * GATE_NS, 2 * WALL_NS) is None
    assert (blocked(made, 5), made.participants["a"].since_wall_ns) == ([], WALL_NS)


@pytest.mark.parametrize(
    ("name", "message", "where", "found"),
    [
        ("nobody", done(0), "join", "missing"),
        ("a", done(0, run_id="run0"), "run_id", "'run0'"),
        ("a", done(0, incarnation=9), "incarnation", "9"),
        ("a", done(0, incarnation=1), "incarnation", "1"),  # of the former incarnation
        ("a", done(2, incarnation=2), "done_ns", "40000000"),
    ],
)
def test_an_invalid_done_is_refused_with_the_reason(name: str, message: Done, where: str, found: str):
    made = barrier("a")
    made.join("a", join(2), 0, 0)
    refusal = made.done(name, message, GATE_NS, 0)
    assert refusal is not None
    assert refusal[:2] == (where, found)
    assert blocked(made, 0) == ["a"]


def test_missing_outputs_of_two_dones_add_up():
    made = barrier("a")
    made.done("a", done(0, sent=2), GATE_NS, 0)
    made.done("a", done(1, sent=2), GATE_NS, 0)
    for _ in range(3):
        made.count_output("a")
        assert incomplete(made) == blocked(made, 1) == ["a"]
    made.count_output("a")
    assert incomplete(made) == blocked(made, 1) == []


def test_outputs_missing_for_a_whole_gate_are_given_up_in_realtime():
    made = barrier("a")
    made.done("a", done(0, sent=2), GATE_NS, 0)
    made.give_up_late()
    assert incomplete(made) == ["a"]
    made.give_up_late()
    assert incomplete(made) == []
    made.done("a", done(1, sent=2), GATE_NS, 0)
    made.give_up_late()
    made.count_output("a")
    made.count_output("a")
    made.give_up_late()
    made.done("a", done(2, sent=2), 2 * GATE_NS, 0)
    assert incomplete(made) == ["a"]


@pytest.mark.parametrize(("recovered", "missing"), [(0, 2), (1, 1), (2, 0), (3, 0)])
def test_a_loss_before_a_reset_does_not_hide_a_later_one(recovered: int, missing: int):
    made = barrier("a")
    made.done("a", done(0, sent=2), GATE_NS, 0)
    for _ in range(recovered):
        made.count_output("a")
    assert made.participants["a"].reset_counts() == missing
    assert incomplete(made) == []
    made.done("a", done(1, sent=1), GATE_NS, 0)
    assert incomplete(made) == ["a"]


def test_a_surplus_from_a_lost_done_does_not_hide_a_later_loss():
    """Of gate 1 only one of the outputs arrived, and no done; this surplus must not offset a loss in gate 2."""
    made = barrier("a")
    made.done("a", done(0), 2 * GATE_NS, 0)
    for _ in range(3):
        made.count_output("a")
    made.done("a", done(2, sent=2), 2 * GATE_NS, 0)
    assert incomplete(made) == blocked(made, 2) == ["a"]
    assert made.participants["a"].reset_counts() == 0
    assert incomplete(made) == blocked(made, 2) == []


@pytest.mark.parametrize(("pid", "lost_done"), [(42, True), (43, False)])
def test_a_done_lost_with_the_link_is_detected_after_the_return(pid: int, lost_done: bool):
    """The same process continues numbering its dones; another in its place starts anew."""
    made = barrier("a")
    made.done("a", done(0), 3 * GATE_NS, 0)
    assert made.join("a", join(2, pid=pid), 3 * GATE_NS, 0) is None
    made.done("a", done(2, incarnation=2), 3 * GATE_NS, 0)
    assert bool(incomplete(made)) == lost_done


def test_a_refused_done_does_not_count_as_lost():
    made = barrier("a")
    made.done("a", done(0), 3 * GATE_NS, 0)
    assert made.join("a", join(incarnation=2), 3 * GATE_NS, 0) is None
    assert made.done("a", done(1, incarnation=1), 3 * GATE_NS, 0)
    assert made.done("a", done(2, incarnation=2), 3 * GATE_NS, 0) is None
    assert incomplete(made) == []


@settings(max_examples=200, deadline=None)
@given(sents=st.lists(st.integers(0, 4), min_size=1, max_size=8), order=st.randoms(use_true_random=False))
def test_nothing_is_missing_once_everything_has_arrived_in_any_order(sents: list[int], order):
    """Outputs and dones arrive on different subscriptions; only dones keep their order among themselves."""
    made = barrier("a")
    last = len(sents) - 1
    arrivals = ["output"] * sum(sents) + ["done"] * len(sents)
    order.shuffle(arrivals)
    waiting = iter(enumerate(sents))
    for arrival in arrivals:
        if arrival == "output":
            made.count_output("a")
        else:
            made.done("a", done(*next(waiting)), last * GATE_NS, 0)
    assert incomplete(made) == blocked(made, last) == []


# Death, drop, and the processes that `clock` reports as waited for


def test_a_dead_process_is_awaited_until_dropped_and_may_rejoin():
    made = barrier("a", "b")
    made.count_output("nobody")
    made.done("b", done(0), 0, 0)
    assert [made.mark_dead(name, 0) is not None for name in ("a", "a", "nobody")] == [True, False, False]
    assert made.is_gating("a")  # what it sent may be read after its death is reported
    assert blocked(made, 0) == ["a"]
    made.remove("a")
    assert not made.is_gating("a")
    assert (blocked(made, 0), made.absent()) == ([], [])
    assert made.done("a", done(0), 0, 0) is not None
    made.join("a", join(2), 6 * GATE_NS, 0)
    assert "a" not in blocked(made, 5)
    assert "a" in blocked(made, 6)


def test_an_incarnation_declared_dead_may_rejoin():
    made = barrier("a")
    made.mark_dead("a", 0)
    made.join("a", join(1), GATE_NS, WALL_NS)
    assert list(made.participants) == ["a"]
    assert made.participants["a"].alive


def test_waiting_for_gives_name_host_and_duration():
    def waiting_for(gate: int, wall_ns: int, start_wall_ns: int = 0) -> tuple[Waiting, ...]:
        return made.waiting_for(gate * GATE_NS, wall_ns, start_wall_ns, lambda writer, reader: False)

    made = Barrier(RUN, GATE_NS, ["estimator.d1", "controller.main"])
    made.join("controller.main", join(host="ground"), 0, 3 * WALL_NS)
    waiting = waiting_for(0, 4 * WALL_NS, 2 * WALL_NS)
    assert waiting == (Waiting("estimator.d1", "", 10.0), Waiting("controller.main", "ground", 5.0))
    made.done("controller.main", done(0), 0, 4 * WALL_NS)
    assert [waiting.name for waiting in waiting_for(0, 4 * WALL_NS)] == ["estimator.d1"]
    made.mark_dead("controller.main", 3 * WALL_NS)  # for a dead process, since its death
    assert waiting_for(2, 5 * WALL_NS)[1] == Waiting("controller.main", "ground", 10.0)
