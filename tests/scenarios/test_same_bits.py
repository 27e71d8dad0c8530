"""The same scenario and seed give the same bits, wherever and in whatever order the processes run."""

import pytest
from federation import PAIR, PAIR_ROLES, Federation

DRONES = ["drone1", "drone2"]


def test_as_processes(federation: Federation, pair_sha256: str) -> None:
    """Every role is a process.

        world ──sensors──▶ estimator.drone1, .drone2 ──estimate──▶ controller.main ──velocity──▶ world
                └──▶ recorder

    Scenario: PAIR, 12 s.
    Expected: the hash of the run in one process, in the end event and over the truth on record.
    """
    federation.run(PAIR).ends(with_code=0)
    federation.nobody_left()
    record = federation.record()
    assert record.complete
    assert record.sha256() == pair_sha256 == record.recomputed_sha256(DRONES)
    assert record.end()["last_ns"] == 12_000_000_000


@pytest.mark.soak
def test_with_all_agents_in_one_process(federation: Federation, pair_sha256: str) -> None:
    """Estimators and controller share a process; the estimators one kernel.

        world ──sensors──▶ ( estimators ──▶ controller ) ──estimates, velocity──▶ world
                └──▶ recorder

    Expected: one participant beside the recorder, everything that the contract has on record, and the same hash.
    """
    federation.run(PAIR, "--hosted").ends(with_code=0)
    federation.nobody_left()
    record = federation.record()
    assert record.sha256() == pair_sha256 == record.recomputed_sha256(DRONES)
    assert {event["subject"] for event in record.events("join")} == {"controller.main", "recorder"}
    for drone in DRONES:
        assert len(record.all(f"drone/{drone}/estimate")) == len(record.all(f"drone/{drone}/truth"))


def test_started_by_hand_world_last_with_one_estimator_for_all(federation: Federation, pair_sha256: str) -> None:
    """The roles are started one by one, the world when all others wait for it; one process estimates every drone.

        controller.main │ recorder │ estimator 'drone*' │ … │ world

    Expected: each says that it waits for a world, then they fly, and the hash is the same.
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


def test_another_seed(federation: Federation, pair_sha256: str) -> None:
    """PAIR with seed 4 instead of 3.

    Expected: another hash.
    """
    federation.run(PAIR, "--in-process", "--seed", "4").ends(with_code=0)
    assert federation.record().sha256() != pair_sha256


@pytest.mark.soak
def test_paced(federation: Federation, pair_sha256: str) -> None:
    """PAIR at ten times real time: pacing is a switch of its own.

    Expected: no faster than asked for, and the same hash.
    """
    federation.run(PAIR, "--rate", "10").ends(with_code=0)
    record = federation.record()
    assert record.sha256() == pair_sha256
    assert record.end()["real_time_factor"] <= 10.1
    assert {event["subject"] for event in record.events("join")} == {"recorder", *PAIR_ROLES}
