"""Three hosts, their certificates, and the `zsim` commands of a user who flies Test 1 on them."""

import json
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from federation import Record, Role
from forked_commands import ROOT, run_here
from lab import LAUNCHER, Lab

from zsim.record import RecordReader, repair
from zsim.scenario import scenario_file
from zsim_analysis.in_process import fly

STEP = ROOT / "scenarios" / "step.yaml"
ROLES = {"world": "h1", "controller.main": "h2", "estimator.*": ["h1", "h2", "h3"]}
FAKETIME = next(map(str, Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1")), None)
START_S = 120.0  # greatest wall time until a run has started, on a busy machine
NAMED_AFTER_S = 2.0  # wall time after which a cut-off host is reported
DISK_BYTES = 1_500_000  # enough for a host's files and a few seconds of a record
GONE_S = 120.0  # wall time within which all processes must have ended on every host once their launcher is gone


class Deployment:
    """A lab, with certificates if it is secure, and the `zsim` commands that run in its launcher's namespace."""

    def __init__(
        self, lab: Lab, roles: dict[str, Any], secure: bool = True, scenario: Path = STEP, **more: Any
    ) -> None:
        self.lab, self.scenario = lab, scenario
        self.out = lab.folder / "out"
        self.hosts = str(lab.inventory(roles, insecure=not secure, **more))
        self._env = {"TMPDIR": str(lab.folder), "XDG_RUNTIME_DIR": str(lab.folder)}
        self.cut_off: set[str] = set()
        self._roles: list[Role] = []
        self._stack = ExitStack()
        if secure:
            self.here("certs", "init", self.hosts, "--scenario", str(scenario))

    def zsim(self, *arguments: str, prefix: tuple[str, ...] = ()) -> Role:
        """Start a command in the launcher's namespace."""
        role = Role(list(arguments), (*self.lab.prefix(LAUNCHER), *prefix), self._env)
        self._roles.append(role)
        return role

    def here(self, *arguments: str) -> str:
        """Run a command that contacts only the launcher to its end in this process; return its output."""
        with pytest.MonkeyPatch.context() as patch:
            for name, value in self._env.items():
                patch.setenv(name, value)
            done = run_here(*arguments)
        assert done.code == 0, done
        return done.stdout

    def up(self, *options: str, prefix: tuple[str, ...] = ()) -> Role:
        """Start a run."""
        where = ["--hosts", self.hosts, "--out", str(self.out)]
        return self.zsim("up", str(self.scenario), *where, "--no-report", *options, prefix=prefix)

    def cut(self, name: str) -> float:
        """Cut off a host; return the wall time (monotonic) [s]."""
        self.lab.cut(name)
        self.cut_off.add(name)
        return time.monotonic()

    def heal(self, name: str) -> None:
        self.lab.heal(name)
        self.cut_off.discard(name)

    def ps(self) -> dict[str, dict[str, Any]]:
        """Return the rows of `zsim ps` by role."""
        return {row["role"]: row for row in json.loads(self.here("ps", "--json"))["rows"]}

    def until_states(self, wanted: Callable[[dict[str, str]], bool]) -> None:
        """Poll the states of the roles until a condition on them holds."""
        until_s = time.monotonic() + START_S
        while not wanted(states := {role: row["state"] for role, row in self.ps().items()}):
            assert time.monotonic() < until_s, states
            threading.Event().wait(0.05)  # the launcher answers requests, but announces no changes

    def kill(self, role: str, number: int = signal.SIGKILL) -> None:
        """Send a signal to a role once it runs; to the latest of its processes while it is being moved."""
        until_s = time.monotonic() + START_S
        while not (pids := self._pids(role)):
            assert time.monotonic() < until_s, f"{role} runs on no host"
            threading.Event().wait(0.05)  # the start of a process that is not a child cannot be awaited
        os.kill(max(pids), number)

    def _pids(self, role: str) -> list[int]:
        lines = [line for host in self.lab.names for line in self.lab.processes(host).items()]
        own = re.compile(rf"\S*python\S* .*/{re.escape(role)}( |$)")  # the path of its certificates
        return [pid for pid, line in lines if own.match(line)]

    def record(self) -> Record:
        """Return the record of the run, after repairing it if it is truncated."""
        path = self.out / "run.mcap"
        repair(path)
        return Record(self._stack.enter_context(RecordReader(path)))

    def nobody_left(self) -> None:
        """Wait until no process of zsim runs on any host; fail if one remains."""
        until_s = time.monotonic() + GONE_S
        while left := {name: found for name in self.lab.names if (found := self.lab.processes(name))}:
            assert time.monotonic() < until_s, left
            threading.Event().wait(0.05)  # the processes are not known in advance

    def close(self) -> None:
        for role in self._roles:
            role.close()
        self._stack.close()


@contextmanager
def closing(deployment: Deployment) -> Iterator[Deployment]:
    """Close a deployment, heal its hosts, and fail if any of its processes remains."""
    try:
        yield deployment
    finally:
        deployment.close()
        for name in list(deployment.cut_off):
            deployment.heal(name)
    deployment.nobody_left()


@pytest.fixture
def deployment(lab: Lab) -> Iterator[Deployment]:
    with closing(Deployment(lab, ROLES)) as made:
        yield made


@pytest.fixture
def small_disk() -> Iterator[Callable[[Path, int], None]]:
    """Yield a function that mounts a file system of a given size [bytes] on a folder."""
    with ExitStack() as stack:

        def mount(folder: Path, size_bytes: int) -> None:
            folder.mkdir(parents=True, exist_ok=True)
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_bytes}", "none", str(folder)], check=True)
            stack.callback(subprocess.run, ["umount", "-l", str(folder)], check=True)

        yield mount


@pytest.fixture
def faketime() -> str:
    """Return the path of the library that gives a process another time."""
    return FAKETIME or pytest.skip("needs libfaketime (apt-get install libfaketime)")


def in_flight(run: Role) -> None:
    """Wait until simulated time advances."""
    run.line(r"real time  (idle|taking_off|assembling|engaged)", START_S)


def in_process(folder: Path, duration_s: float, overrides: Sequence[str] = ()) -> str:
    """Fly the scenario in this process; return its truth_sha256."""
    path = folder / "alone.mcap"
    fly(scenario_file.load(STEP, overrides, duration_s=duration_s), path)
    with RecordReader(path) as reader:
        return Record(reader).sha256()
