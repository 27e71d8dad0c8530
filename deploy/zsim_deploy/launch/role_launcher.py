"""Starts, watches and stops the processes of a run on this host; their output goes to log files.

On Linux they are forked from the fork server, a process that has already imported everything, which is much faster.
On other systems, and if the fork server has ended or does not answer, they are started as programs. Either way they are
children of this process.

This module also launches users' programs, which are started and supervised like roles, and the console, which outlives
the run.
"""

import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Protocol

from zsim.errors import printable
from zsim.runtime.progress import SlowStart
from zsim.scenario.scenario import Scenario
from zsim_api.programs import Program, environment_of, fill_placeholders
from zsim_api.run_folder import Launch
from zsim_deploy import SAFE_PATH
from zsim_deploy.launch.supervisor import Outcome, RunProcess, end_text, last_line
from zsim_deploy.roles.stop_channel import interruptible

SINGLE_THREADED = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}  # threads slow down operations on matrices of a dozen rows, and would compete with the other roles
FORKSERVER = (sys.executable, SAFE_PATH, "-m", "zsim_deploy.cli.forkserver")
COMMAND = (sys.executable, SAFE_PATH, "-m", "zsim_deploy.cli")
ZSIM = (sys.executable, SAFE_PATH, "-m", "zsim_deploy")  # as a user starts it: Ctrl-C while it loads prints one line
ROOM = " " * 1024  # pads the fork server's command line, which each role overwrites with its own
PR_SET_CHILD_SUBREAPER, PR_GET_CHILD_SUBREAPER = 36, 37  # linux/prctl.h
PACKET_MAX = 1 << 17  # maximum size of a packet with a command line, bytes; a thousand drone names take half of it
REPLY_MAX = 32  # maximum size of a reply (READY or a process id), bytes
ANSWER_S = 5.0  # wall time for the fork server to reply, which takes 20 ms unless the server is stopped
POLL_S = 0.01  # interval between checks whether a process has ended, wall time
UNKNOWN = 0  # exit code if the status was collected elsewhere; Popen does the same
HERE = "here"  # shown as the host of a program that `zsim up` starts itself
LEAVES_S = 2.0  # wall time for a program to notice the end of the run before it is interrupted
END_S = 10.0  # wall time for a replay's console to end
COPIED_S = 22.0  # wall time for a run's console to end; its pages may take 20 s to copy the report and the record
INTERRUPTED_S = 1.0  # the same after Ctrl-C; 3 s in all are promised, of which the run may take 2 s
SLOW_S = 2.0  # wall time after which a notice says that a console has not ended yet


class RoleProcess(Protocol):
    pid: int
    stdin: IO[str] | None
    stdout: IO[str] | None

    def poll(self) -> int | None: ...
    def wait(self, timeout: float | None = None) -> int: ...
    def kill(self) -> None: ...


class ChildProcess:
    """A role, run as a child process.

    Args:
        arguments: arguments of the `zsim` command.
        logs: folder of the log, which receives the role's standard error.
        on_line: called with each line of the role's standard output; None: standard output goes to the log too.
    """

    is_program = False

    def __init__(
        self,
        name: str,
        arguments: list[str],
        logs: Path,
        launcher: "RoleLauncher",
        on_line: Callable[[str], None] | None = None,
    ) -> None:
        self.name = name
        self.role = name.split(".", 1)[0]
        self.restarts = 0
        self._arguments = arguments
        self._log = logs / f"{name}.log"
        self._launcher = launcher
        self._on_line = on_line
        self._reader: threading.Thread | None = None
        self._process: RoleProcess | None = None

    def start(self) -> None:
        with self._log.open("a") as log:
            self._process = process = self._launcher.start(self._arguments, log, listened=self._on_line is not None)
        if on_line := self._on_line:

            def read() -> None:
                assert process.stdout is not None
                for line in process.stdout:
                    on_line(line)

            self._reader = threading.Thread(target=read, daemon=True)
            self._reader.start()

    @property
    def pid(self) -> int:
        return self._process.pid if self._process else 0

    @property
    def code(self) -> int | None:
        """Exit code: None until the process has ended, negative if a signal ended it."""
        return self._process.poll() if self._process else None

    def outcome(self) -> str:
        return end_text(self.code, self.last_log_line())

    def last_log_line(self) -> str:
        return last_line(self._log)

    def request_stop(self, reason: str) -> None:
        """Ask the process to leave; no effect once it has ended."""
        if self._process is None or self._process.stdin is None or self._process.stdin.closed:
            return
        with suppress(OSError):  # the process has ended
            self._process.stdin.write(f"stop {reason}\n")
            self._process.stdin.flush()

    def wait(self, timeout_s: float) -> bool:
        if self._process is None:
            return True
        try:
            self._process.wait(timeout=max(0.0, timeout_s))
        except subprocess.TimeoutExpired:
            return False
        if self._reader is not None:
            self._reader.join(timeout=1.0)
        return True

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        if self._process is None:
            return
        self.kill()
        self._process.wait()
        if self._reader is not None:
            self._reader.join(timeout=1.0)
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                if pipe is not None:
                    pipe.close()


class RoleLauncher:
    """Starts roles. A context manager for the main thread; entering it waits until roles can be started.

    `say` is called with notices of slow steps; `run` labels the fork server in the output of `ps`.
    """

    def __init__(self, say: Callable[[str], None], run: str = "") -> None:
        self._say = say
        self._run = run
        self._forkserver: subprocess.Popen[bytes] | None = None
        self._line: socket.socket | None = None
        self._lock = threading.Lock()

    def __enter__(self) -> "RoleLauncher":
        if sys.platform == "linux":
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # it may be inherited as ignored
            try:
                self._start_forkserver()
            except BaseException:  # including Ctrl-C
                self._stop_forkserver()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_forkserver()

    def start(self, arguments: Sequence[str], log: IO[str], listened: bool) -> RoleProcess:
        """Start a `zsim` command with a pipe as standard input.

        Standard error goes to the log. So does standard output, unless `listened`: then it is a pipe too.
        """
        with self._lock:
            return self._fork(arguments, log, listened) or subprocess.Popen(
                [*COMMAND, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if listened else log,
                stderr=log,
                text=True,
                env={**SINGLE_THREADED, **os.environ},
                start_new_session=True,
            )

    def _start_forkserver(self) -> None:
        self._line, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with other:
            devnull, environment = subprocess.DEVNULL, {**SINGLE_THREADED, **os.environ}
            self._forkserver = subprocess.Popen(
                [*FORKSERVER, self._run, ROOM], stdin=other.fileno(), stdout=devnull, stderr=devnull, env=environment,
                start_new_session=True,
            )  # fmt: skip
        start = SlowStart(self._say)
        try:
            self._receive()
        finally:
            start.over()

    def _fork(self, arguments: Sequence[str], log: IO[str], listened: bool) -> "ForkedProcess | None":
        """Fork a role, and start it by writing a byte; return None if the fork server cannot fork it."""
        packet = json.dumps(list(arguments)).encode()
        if self._line is None or len(packet) > PACKET_MAX:
            return None
        (go_read, go_write), (stdin_read, stdin_write) = os.pipe(), os.pipe()
        out_read, out_write = os.pipe() if listened else (None, log.fileno())
        self._line.settimeout(ANSWER_S)
        reply = b""
        with _subreaper():
            try:
                socket.send_fds(self._line, [packet], [stdin_read, out_write, log.fileno(), go_read])
            except OSError:
                self._stop_forkserver()
            else:
                reply = self._receive()
        for file in (go_read, stdin_read, *([out_write] if listened else [])):
            os.close(file)
        if not reply:
            for file in (go_write, stdin_write, out_read):
                if file is not None:
                    os.close(file)
            return None
        with suppress(BrokenPipeError):  # the role was killed
            os.write(go_write, b"!")
        os.close(go_write)
        return ForkedProcess(int(reply), os.fdopen(stdin_write, "w"), None if out_read is None else os.fdopen(out_read))

    def _receive(self) -> bytes:
        """Return the fork server's reply; if it has ended or is silent, stop it and return an empty reply."""
        reply = b""
        if self._line is not None:
            with suppress(OSError):
                reply = self._line.recv(REPLY_MAX)
        if not reply:
            self._stop_forkserver()
        return reply

    def _stop_forkserver(self) -> None:
        """End the fork server, so that later roles are started as programs."""
        if self._line is not None:
            self._line.close()
            self._line = None
        if self._forkserver is not None:
            self._forkserver.kill()  # it may still be importing, or be stopped
            self._forkserver.wait()


class ForkedProcess:
    def __init__(self, pid: int, stdin: IO[str], stdout: IO[str] | None) -> None:
        self.pid = pid
        self.stdin: IO[str] | None = stdin
        self.stdout = stdout
        self._code: int | None = None
        self._lock = threading.RLock()

    def poll(self) -> int | None:
        with self._lock:
            if self._code is None:
                try:
                    pid, status = os.waitpid(self.pid, os.WNOHANG)
                except ChildProcessError:
                    self._code = UNKNOWN
                else:
                    self._code = os.waitstatus_to_exitcode(status) if pid else None
            return self._code

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit code once the process ends; raise subprocess.TimeoutExpired after `timeout` seconds."""
        until_s = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if until_s is not None and time.monotonic() >= until_s:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
            time.sleep(POLL_S)
        return code

    def kill(self) -> None:
        with self._lock, suppress(ProcessLookupError):
            if self.poll() is None:
                os.kill(self.pid, signal.SIGKILL)


@contextmanager
def _subreaper() -> Iterator[None]:
    libc, previous = ctypes.CDLL(None), ctypes.c_int()
    libc.prctl(PR_GET_CHILD_SUBREAPER, ctypes.byref(previous), 0, 0, 0)
    libc.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        yield
    finally:
        libc.prctl(PR_SET_CHILD_SUBREAPER, previous.value, 0, 0, 0)


class ProgramProcess:
    """A user's program, as a `RunProcess`; its output goes to the log NAME.log.

    Args:
        command: the command line.
        folder: working folder; None: the current one.
    """

    is_program = True
    host = HERE

    def __init__(
        self, name: str, command: Sequence[str], logs: Path, environment: Mapping[str, str], folder: Path | None
    ) -> None:
        self.name = name
        self.role = name.partition(".")[0]
        self.restarts = 0
        self._command, self._environment, self._folder = command, environment, folder
        self._log = logs / f"{name}.log"
        self._program: Program | None = None
        self._interruption: threading.Timer | None = None

    def start(self) -> None:
        if self._program is not None:
            self._program.close()
        self._program = Program(self._command, self._environment, self._log, self._folder)

    @property
    def state(self) -> str:
        return "ended" if self.code is not None else "running" if self._program else "starting"

    @property
    def pid(self) -> int:
        return self._program.pid if self._program else 0

    @property
    def code(self) -> int | None:
        """Exit code: None until the process has ended, negative if a signal ended it."""
        code = self._program.code if self._program else None
        return code if code is None or code <= 128 else 128 - code

    def outcome(self) -> str:
        return end_text(self.code, self.last_log_line())

    def last_log_line(self) -> str:
        return last_line(self._log)

    def request_stop(self, reason: str) -> None:
        """Interrupt the program, as Ctrl-C does, unless it ends on its own within LEAVES_S; `reason` is not used."""
        if self._program is not None and self._interruption is None:
            self._interruption = threading.Timer(LEAVES_S, self._program.interrupt)
            self._interruption.daemon = True
            self._interruption.start()

    def wait(self, timeout_s: float) -> bool:
        return self._program is None or self._program.wait(max(0.0, timeout_s)) is not None

    def kill(self) -> None:
        if self._program is not None:
            self._program.kill()

    def close(self) -> None:
        if self._interruption is not None:
            self._interruption.cancel()
        if self._program is not None:
            self._program.close()


def programs_of(
    scenario: Scenario, names: Iterable[str], endpoint: str, out: Path, launch: Launch
) -> list[ProgramProcess]:
    """Return processes for a scenario's own programs; they run in the folder of the scenario's file and modules.

    Args:
        names: names of the programs.
        endpoint: the run's endpoint.
        out: the run's folder.
    """
    folder, environment = next(map(Path, launch.modules), None), environment_of(endpoint, scenario.federation)
    values = {"endpoint": endpoint, "federation": scenario.federation, "folder": str(out.absolute())}
    return [
        ProgramProcess(
            name,
            fill_placeholders(scenario.own_programs[name].command, {**values, "name": name}),
            out / "logs",
            environment,
            folder,
        )
        for name in names
    ]


class RunConsole:
    """Owns the console of a run, which stays up until the report has been made and the console's pages have copied it.

    A context manager, to be entered before the run so that the console always ends. Ctrl-C ends the wait for the pages.
    """

    def __init__(self) -> None:
        self.process: RunProcess | None = None
        self.outcome = Outcome("interrupted", interrupted=True)  # outcome of the run, set by the caller

    def own(self, process: RunProcess) -> None:
        """Take over a console process that has not been started, and end the previous one."""
        if self.process is not None:
            self.process.close()
        self.process = process

    def __enter__(self) -> "RunConsole":
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if self.process is None:
            return
        is_hurried = self.outcome.interrupted or isinstance(error, (KeyboardInterrupt, SystemExit))
        limit_s = INTERRUPTED_S if is_hurried else COPIED_S
        try:
            with interruptible():
                self.process.request_stop(self.outcome.reason)
                if not self.process.wait(min(SLOW_S, limit_s)) and limit_s > SLOW_S:
                    text = f"{self.process.name}: its pages may copy the report and the record; Ctrl-C ends that"
                    print(printable(text), file=sys.stderr)
                    self.process.wait(limit_s - SLOW_S)
        except KeyboardInterrupt:
            pass  # the run is over already
        finally:
            self.process.close()


@contextmanager
def running_console(endpoint: str, record: Path, federation: str | None, tls: Path | None) -> Iterator[None]:
    """Run a console for the duration of the `with` block; it waits for the world, and prints the links to its pages.

    It connects to `endpoint`, with 127.0.0.1 in place of 0.0.0.0 (all addresses); the default federation is the
    record's.
    """
    if federation is None:
        from zsim_analysis.reading.recorded_run import open_run

        with open_run(record) as (_, _, scenario):
            federation = scenario.federation
    arguments = ["--connect", endpoint.replace("0.0.0.0", "127.0.0.1"), "--federation", federation]
    process = subprocess.Popen([*ZSIM, "console", *arguments, *(["--tls", str(tls)] if tls else [])])
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
