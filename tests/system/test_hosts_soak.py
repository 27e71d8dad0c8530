"""Repeated faults of each kind at random simulated times on three hosts, with a table of outcomes (`make soak`)."""

import errno
import functools
import os
import random
import re
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from deployment import DISK_BYTES, NAMED_AFTER_S, ROLES, START_S, Deployment, closing, in_flight, in_process
from federation import Role
from lab import Lab
from said_lines import say

pytestmark = pytest.mark.soak

REPETITIONS = 5
DURATION_S, RATE = 60.0, 8  # simulated time; ratio of simulated to wall time
LATEST_S = 30.0  # simulated time from the start to the latest fault
CUTS_S = {"cut 1 s": 1.0, "cut 5 s": 5.0, "cut 20 s": 20.0}
LOSING = ("estimator.drone1", "estimator.drone3", "controller.main")
RECORDER, WORLD = "recorder", "world"
CLOCK, DISK, LAUNCHER, ROUTER = "clock an hour off", "disk full", "launcher", "router.field"
KINDS = (*LOSING, WORLD, RECORDER, ROUTER, LAUNCHER, *CUTS_S, CLOCK, DISK)


class Outcome(NamedTuple):
    kind: str
    survived: bool
    named_after_s: float | None
    """Wall time from the fault to the line that reports it; None if no line is expected."""


class Tally:
    """The outcomes of all repetitions."""

    def __init__(self) -> None:
        self.outcomes: list[Outcome] = []

    def lines(self) -> Iterator[str]:
        yield f"{'kind':20} {'repetitions':>11} {'survived':>8} {'lost':>5} {'named within':>12}"
        for kind in KINDS:
            yield from self._line(kind, [each for each in self.outcomes if each.kind == kind])
        yield from self._line("all", self.outcomes)

    @staticmethod
    def _line(kind: str, outcomes: list[Outcome]) -> Iterator[str]:
        if outcomes:
            survived = sum(each.survived for each in outcomes)
            named = [each.named_after_s for each in outcomes if each.named_after_s is not None]
            within = f"{max(named):.2f} s" if named else "-"
            yield f"{kind:20} {len(outcomes):11} {survived:8} {len(outcomes) - survived:5} {within:>12}"


@pytest.fixture(scope="module")
def tally(request: pytest.FixtureRequest) -> Iterator[Tally]:
    made = Tally()
    yield made
    say(request, made.lines())


@functools.cache
def undisturbed() -> str:
    with tempfile.TemporaryDirectory() as folder:
        return in_process(Path(folder), DURATION_S)


@pytest.mark.parametrize("repetition", range(REPETITIONS))
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_ends_as_expected_after_a_fault_at_a_random_time(
    lab: Lab,
    small_disk: Callable[[Path, int], None],
    faketime: str,
    tally: Tally,
    kind: str,
    repetition: int,
) -> None:
    chance = random.Random(f"{kind} {repetition}")
    deployment = prepared(lab, kind, chance, small_disk, faketime)
    tally.outcomes.append(Outcome(kind, False, None))
    with closing(deployment):
        run = deployment.up("--rate", str(RATE), "--duration", str(DURATION_S))
        in_flight(run)
        threading.Event().wait(chance.uniform(0.0, LATEST_S) / RATE)
        named_after_s = strike(deployment, run, kind, chance)
        if kind != LAUNCHER:
            judge(deployment, run, kind)
    tally.outcomes[-1] = Outcome(kind, True, named_after_s)


def prepared(
    lab: Lab, kind: str, chance: random.Random, small_disk: Callable[[Path, int], None], faketime: str
) -> Deployment:
    """Return a deployment in which a fault of this kind can occur or is present from the start."""
    if kind == ROUTER:
        return Deployment(lab, ROLES, routers={"field": {"host": "h2"}}, through={"h2": "field", "h3": "field"})
    if kind == CLOCK:
        offset = chance.choice(("-1h", "+1h"))
        lab.environment("h3", LD_PRELOAD=faketime, FAKETIME=offset, FAKETIME_DONT_FAKE_MONOTONIC="1")
    if kind == DISK:
        small_disk(lab.host_folder("h3"), round(DISK_BYTES * chance.uniform(1.0, 3.0)))
        lab.environment("h3")  # a new sshd, which sees the new disk
        return Deployment(lab, {**ROLES, "recorder": "h3"})
    return Deployment(lab, ROLES)


def strike(deployment: Deployment, run: Role, kind: str, chance: random.Random) -> float | None:
    """Cause a fault; return the wall time [s] until a line reports it, if one does."""
    if kind in (CLOCK, DISK):
        return None
    at_s = time.monotonic()
    if kind in CUTS_S:
        host = chance.choice(("h2", "h3"))
        return cut_off(deployment, run, host, CUTS_S[kind])
    if kind == LAUNCHER:
        run.signal(signal.SIGKILL)
        return None
    deployment.kill(kind)
    return run.line(rf"{kind} .*(killed by signal 9)", START_S).wall_s - at_s


def cut_off(deployment: Deployment, run: Role, host: str, for_s: float) -> float | None:
    """Cut a host off for `for_s`; return the wall time [s] until it is reported, if it is."""
    at_s = deployment.cut(host)
    is_named, named_after_s = for_s > NAMED_AFTER_S, None
    if is_named:
        named_after_s = run.line(f"host {host} does not answer", START_S).wall_s - at_s
        run.line(f"waiting for .* on {host}", START_S)
    threading.Event().wait(at_s + for_s - time.monotonic())
    deployment.heal(host)
    if is_named:
        run.line(f"host {host} answers again", START_S)
    return named_after_s


def judge(deployment: Deployment, run: Role, kind: str) -> None:
    """Check that the run ended, and recorded, as it must after a fault of this kind."""
    run.ends(with_code=1 if kind == DISK else 0, within_s=START_S + CUTS_S.get(kind, 0.0))
    record = deployment.record()
    assert record.keys()["clock"] > 1
    if kind in (*LOSING, RECORDER):
        assert [event["subject"] for event in record.events("restart")] == [kind]
    if kind == WORLD:
        assert record.events("death") == []
    if kind == CLOCK:
        assert re.search(r"warning: h3: its clock is -?3[56]\d\d\.\d s off", run.text())
    if kind == DISK:
        assert os.strerror(errno.ENOSPC) in run.text()
    else:
        assert record.sha256() == undisturbed()
