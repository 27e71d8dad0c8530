"""The same scenario and seed give the same bits, wherever the processes run and in whatever order they start."""

import pytest
from federation import PAIR, PAIR_ROLES, Federation

DRONES = ["drone1", "drone2"]


def test_separate_processes_give_the_same_hash(federation: Federation, pair_sha256: str) -> None:
    """Every role runs as a process of its own.

        world ──sensors──▶ estimator.drone1, .drone2 ──estimate──▶ controller.main ──velocity──▶ world
                └──▶ recorder

    Scenario: PAIR, 12 s.
    Expected: the hash of the run in a single process, both in the event `end` and recomputed from the recorded truth.
    """
    federation.run(PAIR).ends(with_code=0)
    federation.nobody_left()
    record = federation.record()
    assert record.complete
    assert record.sha256() == pair_sha256 == record.recomputed_sha256(DRONES)
    assert record.end()["last_ns"] == 12_000_000_000


@pytest.mark.soak
def test_agents_in_one_process_give_the_same_hash(federation: Federation, pair_sha256: str) -> None:
    """Estimators and controller share a process, and the estimators share a kernel.

        world ──sensors──▶ ( estimators ──▶ controller ) ──estimates, velocity──▶ world
                └──▶ recorder

    Expected: one participant besides the recorder, all messages of the contract on record, and the same hash.
    """
    federation.run(PAIR, "--hosted").ends(with_code=0)
    federation.nobody_left()
    record = federation.record()
    assert record.sha256() == pair_sha256 == record.recomputed_sha256(DRONES)
    assert {event["subject"] for event in record.events("join")} == {"controller.main", "recorder"}
    for drone in DRONES:
        assert len(record.all(f"drone/{drone}/estimate")) == len(record.all(f"drone/{drone}/truth"))


def test_roles_started_by_hand_give_the_same_hash(federation: Federation, pair_sha256: str) -> None:
    """The roles are started by hand, the world last; one process estimates the state of every drone.

        controller.main │ recorder │ estimator 'drone*' │ … │ world

    Expected: each role reports that it is waiting for a world; then they fly, and the hash is the same.
    """
    others = [
        federation.role("controller", "main"),
        federation.role("record", "--out", str(federation.out)),
        federation.role("estimator", "drone*"),
    ]
    for role in others:
        role.line("waiting for a world of 'zsim' on")
    world = federation.world(PAIR, "--expect", "recorder")
    for role in (world, *others):
        role.ends(with_code=0)
    assert federation.record().sha256() == pair_sha256


def test_another_seed_gives_another_hash(federation: Federation, pair_sha256: str) -> None:
    """PAIR with seed 4 instead of 3."""
    federation.run(PAIR, "--in-process", "--seed", "4").ends(with_code=0)
    assert federation.record().sha256() != pair_sha256


@pytest.mark.soak
def test_a_paced_run_gives_the_same_hash(federation: Federation, pair_sha256: str) -> None:
    """PAIR is paced at ten times real time.

    Expected: a real-time factor no greater than requested, and the same hash.
    """
    federation.run(PAIR, "--rate", "10").ends(with_code=0)
    record = federation.record()
    assert record.sha256() == pair_sha256
    assert record.end()["real_time_factor"] <= 10.1
    assert {event["subject"] for event in record.events("join")} == {"recorder", *PAIR_ROLES}
