"""The same scenario and seed give the same bits, wherever and in whatever order the processes run."""

import subprocess
import sys
from collections.abc import Iterator

import pytest
from federation import PAIR, PAIR_ROLES, Federation

DRONES = ["drone1", "drone2"]


@pytest.fixture(scope="module")
def sha256(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> str:
    """The hash of PAIR flown in one process, checked against the truth on record."""
    with Federation(tmp_path_factory.mktemp("reference")) as federation:
        federation.run(PAIR, "--in-process").ends(with_code=0)
        record = federation.record()
        assert record.recomputed_sha256(DRONES) == record.sha256()
        assert record.positions("drone1")[-1][2] > 1.0  # it flies
        return record.sha256()


@pytest.fixture
def busy_cores() -> Iterator[None]:
    """A process that computes for ever on each of two cores."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    yield
    for process in busy:
        process.kill()
        process.wait()


def test_as_processes(federation: Federation, sha256: str) -> None:
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
    assert record.sha256() == sha256 == record.recomputed_sha256(DRONES)
    assert record.end()["last_ns"] == 12_000_000_000


@pytest.mark.usefixtures("busy_cores")
def test_with_loaded_cores(federation: Federation, sha256: str) -> None:
    """As before, while two other processes take all they can get of the machine.

    Expected: slower, and the same hash.
    """
    federation.run(PAIR).ends(with_code=0, within_s=180)
    assert federation.record().sha256() == sha256


def test_started_by_hand_world_last(federation: Federation, sha256: str) -> None:
    """The roles are started one by one, the world when all others wait for it.

        controller.main │ recorder │ estimator.drone2 │ estimator.drone1 │ … │ world

    Expected: each says that it waits for a world, then they fly, and the hash is the same.
    """
    others = [
        federation.role("controller", "main"),
        federation.role("record", "--out", str(federation.out)),
        federation.role("estimator", "drone2"),
        federation.role("estimator", "drone1"),
    ]
    for role in others:
        role.line("waiting for a world of 'zsim' on")
    world = federation.world(PAIR, "--expect", "recorder")
    for role in (world, *others):
        role.ends(with_code=0)
    assert federation.record().sha256() == sha256


def test_another_seed(federation: Federation, sha256: str) -> None:
    """PAIR with seed 4 instead of 3.

    Expected: another hash.
    """
    federation.run(PAIR, "--in-process", "--seed", "4").ends(with_code=0)
    assert federation.record().sha256() != sha256


def test_paced(federation: Federation, sha256: str) -> None:
    """PAIR at ten times real time: pacing is a switch of its own.

    Expected: no faster than asked for, and the same hash.
    """
    federation.run(PAIR, "--rate", "10").ends(with_code=0)
    record = federation.record()
    assert record.sha256() == sha256
    assert record.end()["real_time_factor"] <= 10.1
    assert {event["subject"] for event in record.events("join")} == {"recorder", *PAIR_ROLES}
