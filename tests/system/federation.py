"""A federation under test: its roles are real processes, observed from outside as by a user.

    def test_...(federation):
        run = federation.run(PAIR, "--rate", "5")             `zsim run`, or
        world = federation.start("world", federation.write(ONE), "--listen", federation.endpoint)
        run.line("engaged")                                   waits for a line of its output
        run.ends(with_code=0)

Nothing sleeps: every wait is for a line, a message or the end of a process. When the test is over, all its processes
are killed. A test that expects them to have ended by themselves calls `nobody_left`.
"""

import fcntl
import hashlib
import os
import re
import select
import signal
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import forked_commands
import msgpack
import numpy as np
import pytest
from forked_commands import COLUMNS, ROOT, ZSIM
from free_ports import free_port
from wire import PATIENCE_S, Client

from zsim.record import RecordReader, repair
from zsim_agents.cameras import detector

COMPILES_S = 600.0  # greatest wall time of compiling

ONE = """
name: one
seed: 3
duration_s: 10
sensors: {preset: paper}
environment: {wind: {gust_m_s: 0.3}}
drones:
  - {name: drone1, position_m: [0, 0, 0], yaw_deg: 90}
processes: {expect: []}
"""
"""One drone that stands on the ground until a program flies it."""

PAIR = """
name: pair
seed: 3
duration_s: 12
sensors: {preset: paper}
environment: {wind: {gust_m_s: 0.3}}
drones:
  - {name: drone1, position_m: [2, 0, 0], yaw_deg: 90}
  - {name: drone2, position_m: [-2, 0, 0], yaw_deg: 90}
clusters:
  - {name: main, drones: [drone1, drone2], plan: {takeoff_s: 0.5}}
"""
"""Two drones that take off at 1 s, hover at 4 s and hold their formation from 5 s on."""

PAIR_ROLES = ("estimator.drone1", "estimator.drone2", "controller.main")


class Line(NamedTuple):
    """A line of output and the wall time (monotonic) of its arrival."""

    wall_s: float
    text: str


class Role:
    """A started command whose output is read continuously.

    Args:
        arguments: arguments of `zsim`.
        prefix: command that starts it, such as `ip netns exec NAME`.
        env: environment variables that differ from those of the tests.
    """

    def __init__(self, arguments: list[str], prefix: tuple[str, ...] = (), env: dict[str, str] | None = None) -> None:
        self.arguments = arguments
        self.lines: list[Line] = []
        self._news = threading.Condition()
        self._closed = False
        if prefix:
            command = [*prefix, *ZSIM, *arguments]
            self.process, self._output = forked_commands.start_program(command, {**COLUMNS, **(env or {})})
        else:
            self.process, self._output = forked_commands.start(arguments, env or {})
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for text in self._output:
            self._note(Line(time.monotonic(), text.rstrip("\n")))
        self._closed = True
        self._note(None)

    def _note(self, line: Line | None) -> None:
        with self._news:
            if line is not None:
                self.lines.append(line)
            self._news.notify_all()

    def line(self, pattern: str, within_s: float = PATIENCE_S, number: int = 1) -> Line:
        """Wait for and return the first line, or that with a number, in which a pattern is found."""
        until_s = time.monotonic() + within_s
        with self._news:
            while True:
                matching = [line for line in self.lines if re.search(pattern, line.text)]
                if len(matching) >= number:
                    return matching[number - 1]
                left_s = until_s - time.monotonic()
                if self._closed or left_s <= 0:
                    break
                self._news.wait(left_s)
        return pytest.fail(f"{self}: no line with {pattern!r} within {within_s:g} s:\n{self.text()}")

    def ends(self, with_code: int | Collection[int], within_s: float = PATIENCE_S) -> float:
        """Wait until it ends with a code or one of several; return the wall time (monotonic) of its end."""
        try:
            code = self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{self}: has not ended within {within_s:g} s:\n{self.text()}")
        end_s = time.monotonic()
        self._reader.join(PATIENCE_S)
        allowed = (with_code,) if isinstance(with_code, int) else with_code
        assert code in allowed, f"{self} ended with {code}:\n{self.text()}"
        return end_s

    def text(self) -> str:
        """Return its output so far."""
        with self._news:
            return "\n".join(line.text for line in self.lines)

    def signal(self, number: int) -> float:
        """Send it a signal if it is alive; return the wall time (monotonic)."""
        if self.process.poll() is None:
            os.kill(self.process.pid, number)
        return time.monotonic()

    def close(self) -> None:
        """Kill it if it is alive, and close its pipe."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join(PATIENCE_S)
        self._output.close()

    def __repr__(self) -> str:
        return f"zsim {' '.join(self.arguments)}"


class Federation:
    """All processes that one test starts, on an endpoint and in a folder of its own."""

    def __init__(self, folder: Path, host: str = "127.0.0.1") -> None:
        self.folder = folder
        self.endpoint = f"tcp/{host}:{free_port(host)}"
        self.out = folder / "run"
        self._roles: list[Role] = []
        self._stack = ExitStack()

    def write(self, scenario: str, name: str = "scenario.yaml") -> str:
        """Write a scenario into the folder; return its path."""
        path = self.folder / name
        path.write_text(scenario)
        return str(path)

    def run(self, scenario: str, *options: str) -> Role:
        """Start `zsim run` on this endpoint, without a report."""
        where = ["--out", str(self.out)]
        where += [] if "--in-process" in options else ["--listen", self.endpoint]
        return self.start("run", self.write(scenario), *where, "--no-report", *options)

    def world(self, scenario: str, *options: str) -> Role:
        """Start a world by hand."""
        return self.start("world", self.write(scenario), "--listen", self.endpoint, *options)

    def role(self, role: str, *arguments: str, prefix: tuple[str, ...] = ()) -> Role:
        """Start another role by hand, as a client of this endpoint."""
        return self.start(role, *arguments, "--connect", self.endpoint, prefix=prefix)

    def start(self, *arguments: str, prefix: tuple[str, ...] = ()) -> Role:
        """Start a `zsim` command."""
        role = Role(list(arguments), prefix)
        self._roles.append(role)
        return role

    def client(self, federation: str = "zsim") -> Client:
        """Return a client of this endpoint, which is closed with the federation."""
        return self._stack.enter_context(Client(self.endpoint, federation))

    def record(self) -> "Record":
        """Return the record of the run, after repairing it if it is truncated."""
        path = self.out / "run.mcap"
        repair(path)
        return Record(self._stack.enter_context(RecordReader(path)))

    def pid(self, name: str) -> int:
        """Return the process id of a role of `zsim run`, found by the arguments of its command."""
        role, _, thing = name.partition(".")
        role = "record" if role == "recorder" else role
        for pid, command in self._processes():
            named = command[3:5] == ["zsim_deploy.cli", role] and (not thing or thing in command[5:])
            hosted = command[3:5] in (["zsim_deploy.cli", "host"], ["zsim_deploy.cli", "agent"]) and name == command[-1]
            if (named or hosted) and "--launched" in command:
                return pid
        return pytest.fail(f"{name} does not run")

    def kill(self, name: str, number: int = signal.SIGKILL) -> float:
        """Send a signal to a role of `zsim run`; return the wall time (monotonic)."""
        os.kill(self.pid(name), number)
        return time.monotonic()

    def left(self) -> list[str]:
        """Return the commands of this federation's processes that are alive."""
        return [" ".join(command) for _, command in self._processes()]

    def nobody_left(self, within_s: float = PATIENCE_S) -> None:
        """Fail if any process of this federation is still alive after `within_s`."""
        until_s = time.monotonic() + within_s
        looks = 0  # in a row that found no process: one alone may miss a child just forked by a parent that has ended
        while looks < 2:
            pids = [pid for pid, _ in self._processes()]
            looks = 0 if pids else looks + 1
            assert all(wait_gone(pid, until_s - time.monotonic()) for pid in pids), self.left()

    def _processes(self) -> Iterator[tuple[int, list[str]]]:
        """Yield id and command of the processes whose command contains this endpoint or folder."""
        marks = (self.endpoint.encode(), str(self.folder).encode())
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit() or int(entry.name) == os.getpid():
                continue
            try:
                line = (entry / "cmdline").read_bytes()
            except OSError:
                continue  # the process has just ended
            if b"zsim_deploy." in line and any(mark in line for mark in marks):  # a role or a fork server of roles
                yield int(entry.name), line.decode(errors="replace").rstrip("\0").split("\0")

    def __enter__(self) -> "Federation":
        return self

    def __exit__(self, *_: object) -> None:
        """Kill all remaining processes, including the launcher's children."""
        self._stack.close()
        for role in self._roles:
            role.close()
        for pid, _command in list(self._processes()):
            os.kill(pid, signal.SIGKILL)


def wait_gone(pid: int, within_s: float) -> bool:
    """Wait for the end of a process that need not be a child; return whether it has ended."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        poller = select.poll()
        poller.register(descriptor)
        return bool(poller.poll(max(0.0, 1000 * within_s)))
    finally:
        os.close(descriptor)


class Record:
    """The contents of a record, read with zsim's reader and msgpack."""

    def __init__(self, reader: RecordReader) -> None:
        self._reader = reader
        self.complete = reader.complete

    def all(self, *keys: str) -> list[dict[str, Any]]:
        """Return the messages on some keys in order of time."""
        return [msgpack.unpackb(message.payload) for message in self._reader.messages(keys)]

    def keys(self) -> dict[str, int]:
        """Return the number of messages by key."""
        return self._reader.topics()

    def events(self, *kinds: str) -> list[dict[str, Any]]:
        """Return the events of some kinds."""
        return [event for event in self.all("world/event") if event["kind"] in kinds]

    def end(self) -> dict[str, Any]:
        """Return the data of the world's event `end`."""
        return self.events("end")[-1]["data"]

    def sha256(self) -> str:
        return self.end()["truth_sha256"]

    def recomputed_sha256(self, drones: list[str]) -> str:
        """Return the hash of the truth, computed as docs/protocol.md defines it from the messages on record."""
        digest = hashlib.sha256()
        for instant in zip(*(self.all(f"drone/{drone}/truth") for drone in drones), strict=True):
            for truth in instant:
                digest.update(struct.pack("<q", truth["t_ns"]))
                parts = ("position_m", "velocity_m_s", "orientation_wxyz", "angular_velocity_rad_s")
                numbers = [number for part in parts for number in truth[part]]
                digest.update(struct.pack("<13d", *numbers))
        return digest.hexdigest()

    def positions(self, drone: str) -> np.ndarray:
        """Return a drone's true positions [m; W], (gates, 3)."""
        return np.array([truth["position_m"] for truth in self.all(f"drone/{drone}/truth")])


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Compile the kernels before anything is timed, in the first test worker that gets here."""
    folder = tmp_path_factory.mktemp("compiled")
    scenario = folder / "pair.yaml"
    scenario.write_text(PAIR)
    flight = ["run", str(scenario), "--in-process", "--duration", "8", "--no-report", "--out", str(folder / "run")]
    checkout = hashlib.sha256(str(ROOT).encode()).hexdigest()[:12]
    these_tests = os.environ.get("PYTEST_XDIST_TESTRUNUID", "")  # the same for all workers
    with (Path(tempfile.gettempdir()) / f"zsim-tests-compile-{checkout}.lock").open("a+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        lock.seek(0)
        if these_tests and lock.read() == these_tests:
            return
        assert forked_commands.run(*flight, hangs_s=COMPILES_S).code == 0
        detector.rehearse()
        lock.truncate(0)
        lock.write(these_tests)


@pytest.fixture
def forked(compiled: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fork the commands that `zsim.Federation` and `zsim.run` start; test_own_tests.py starts them as a user does."""
    for module in ("federation", "flight"):
        monkeypatch.setattr(f"zsim_api.{module}.Program", forked_commands.program)


@pytest.fixture
def federation(tmp_path: Path, compiled: None) -> Iterator[Federation]:
    """Yield a federation of the test's own, none of whose processes outlives the test."""
    with Federation(tmp_path) as made:
        yield made
