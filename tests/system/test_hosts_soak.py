"""Faults at random simulated times on three hosts, many of each kind: `make soak`."""

import functools
import os
import random
import signal
import tempfile
import threading
from pathlib import Path

import pytest
from lab import Lab
from test_hosts import ROLES, START_S, Team, closing, in_flight, in_process

pytestmark = pytest.mark.soak

REPETITIONS = 6
DURATION_S, RATE = 60.0, 8  # simulated
LATEST_S = 30.0  # simulated, of a fault, after the first 10 s
CUTS_S = {"cut 1 s": 1.0, "cut 5 s": 5.0, "cut 20 s": 20.0}
LOSING = ("estimator.drone1", "estimator.drone3", "controller.main")  # a kill loses the process's state
ENDING = ("world", "recorder")
KINDS = (*LOSING, *ENDING, "router.field", "launcher", *CUTS_S)


@functools.cache
def undisturbed() -> str:
    with tempfile.TemporaryDirectory() as folder:
        return in_process(Path(folder), DURATION_S)


@pytest.mark.parametrize("repetition", range(REPETITIONS))
@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_at_a_random_time(lab: Lab, kind: str, repetition: int) -> None:
    chance = random.Random(f"{kind} {repetition}")
    routed = {"routers": {"field": {"host": "h2"}}, "through": {"h2": "field", "h3": "field"}}
    with closing(Team(lab, ROLES, **(routed if kind == "router.field" else {}))) as team:
        run = team.up("--rate", str(RATE), "--duration", str(DURATION_S))
        in_flight(run)
        rows = team.ps()
        threading.Event().wait(chance.uniform(0.0, LATEST_S) / RATE)
        if kind == "launcher":
            run.signal(signal.SIGKILL)
            return
        if kind in CUTS_S:
            cut_off(team, chance.choice(("h2", "h3")), CUTS_S[kind])
        else:
            os.kill(rows[kind]["pid"], signal.SIGKILL)
        run.ends(with_code=1 if kind in ENDING else 0, within_s=START_S + CUTS_S.get(kind, 0.0))
        record = team.record()
        if kind in LOSING:
            assert [event["subject"] for event in record.events("restart")] == [kind]
        elif kind not in ENDING:
            assert record.sha256() == undisturbed()
        assert record.keys()["clock"] > 1


def cut_off(team: Team, host: str, for_s: float) -> None:
    """Cut a host off for so long."""
    team.cut(host)
    threading.Event().wait(for_s)
    team.heal(host)
