"""How a process is stopped: by a signal, by its launcher, or because the launcher has died.

The standard input of a launched process is a pipe from its launcher. The launcher writes "stop REASON"; when it dies,
the pipe closes. Thus no process outlives its launcher, on any system, even after kill -9. A launcher on another host
writes "orphan-after SECONDS" and then a "beat" every second, because the loss of a host closes no pipe. A launched
process that receives SIGTERM also ends in an orderly way, but is treated as dead, because its launcher did not
request that.

A process that ends removes the private key that `zsim up` has copied to its host. This module also has
`lower_priority`, for processes that no gate waits for.
"""

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from zsim.transport.tls import KEY, Identity
from zsim_deploy import INTERRUPTED
from zsim_deploy.roles.closed_output import CLOSED, redirect_output, write_error

REASONS: dict[int, str] = {signal.SIGINT: "interrupted by Ctrl-C", signal.SIGTERM: "terminated"}
HANGUP = (signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()  # not on Windows
TWICE_INTERRUPTED = "interrupted twice, ended without waiting"
TERMINATED = 128 + signal.SIGTERM  # exit code after SIGTERM, as in shells
GRACE_S = 4.0  # wall time to end after the launcher is lost, before being killed; to heed a stop, before an interrupt
FOLDER = "identity"  # folder of certificates, in the folder of a run on a host
NICE = 5  # nice value of processes that no gate waits for
AUTOGROUP = Path("/proc/self/autogroup")  # sched(7)
TRIES = 5  # attempts to write AUTOGROUP
AGAIN_S = 0.12  # wall time between attempts; the kernel allows all ordinary users together ten writes a second


class StopChannel:
    """Receives the request to stop a process, and stores its reason.

    Args:
        launched: id of the run for which a launcher started the process; standard input is then the pipe from the
            launcher, and Ctrl-C is ignored, because the launcher handles it. None: started by hand.
        identity: identity of the process; a key copied here by the launcher is removed as soon as the launcher is lost.
        held_by: only for a process that itself runs a user's code; returns, for a frame of the main thread, which code
            is running. If `reason` is not called within GRACE_S of the request, or the user presses Ctrl-C again,
            KeyboardInterrupt is raised in that code.
    """

    def __init__(
        self,
        launched: str | None = None,
        identity: Identity | None = None,
        held_by: Callable[[FrameType | None], str] | None = None,
    ) -> None:
        self._lease = key_lease(identity, launched) if identity else None
        self._reason: str | None = None
        self._held_by, self._is_heeded = held_by, threading.Event()
        self._orphaned = self._terminated = False
        self._last_line_s = time.monotonic()
        self._former = {number: signal.getsignal(number) for number in (*REASONS, *HANGUP)}
        if launched is not None:
            handlers = {signal.SIGTERM: self._on_kill, signal.SIGINT: signal.SIG_IGN}
            threading.Thread(target=self._read, name="stop channel", daemon=True).start()
        else:
            handlers = {signal.SIGTERM: lambda *_: self._stop("terminated"), signal.SIGINT: self._on_interrupt}
            # SIGHUP is left alone if it is ignored, as under nohup, or already handled.
            fatal = (number for number in HANGUP if signal.getsignal(number) is signal.SIG_DFL)
            handlers |= dict.fromkeys(fatal, self._on_hangup)
        for number, handler in handlers.items():
            signal.signal(number, handler)

    def reason(self) -> str | None:
        if self._reason is not None:
            self._is_heeded.set()
        return self._reason

    def stopped(self) -> bool:
        return self._reason is not None

    def orphaned(self) -> bool:
        """Whether the launcher is lost, or did not request this end; to others, the end must then look like a death."""
        return self._orphaned

    def exit_if_terminated(self) -> None:
        """Exit with the code that tells the launcher that SIGTERM came from elsewhere, if it did; to be called last."""
        if self._terminated:
            raise SystemExit(TERMINATED)

    def restore_signals(self) -> None:
        """Restore the previous signal handlers, so that the remaining work can be interrupted as usual."""
        self._is_heeded.set()
        for number, handler in self._former.items():
            signal.signal(number, handler)

    def _stop(self, reason: str) -> None:
        if self._held_by and self._reason is None:
            threading.Thread(target=self._insist, name="stop", daemon=True).start()
        self._reason = self._reason or reason

    def _insist(self) -> None:
        if self._is_heeded.wait(GRACE_S):
            return
        if hasattr(signal, "pthread_kill"):  # also wakes the main thread if it sleeps
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        else:  # Windows, where Python handles a signal from any thread in the main thread
            signal.raise_signal(signal.SIGINT)

    def _on_kill(self, *_: object) -> None:
        if self._reason is None:
            self._orphaned = self._terminated = True
        self._stop(REASONS[signal.SIGTERM])

    def _on_hangup(self, *_: object) -> None:
        """End as after SIGTERM, without writing to a terminal that may be closed."""
        redirect_output(Path(os.devnull))
        self._stop(CLOSED)

    def _on_interrupt(self, _: int, frame: FrameType | None) -> None:
        if self._reason is not None and self._held_by:
            raise KeyboardInterrupt(f"{self._reason}{self._held_by(frame)}")
        if self._reason is not None:
            write_error(TWICE_INTERRUPTED)
            os._exit(INTERRUPTED)
        self._stop(REASONS[signal.SIGINT])

    def _read(self) -> None:
        def await_beats(limit_s: float) -> None:
            while (left_s := self._last_line_s + limit_s - time.monotonic()) > 0:
                time.sleep(left_s)
            self._leave(f"no heartbeat from the launcher for {limit_s:g} s")

        for line in sys.stdin:
            self._last_line_s = time.monotonic()
            command, _, argument = line.strip().partition(" ")
            if command == "stop":
                self._stop(argument or "stopped by the launcher")
            elif command == "orphan-after":
                threading.Thread(target=await_beats, args=(float(argument),), name="beats", daemon=True).start()
        self._leave("the launcher is gone")

    def _leave(self, reason: str) -> None:
        self._orphaned = True
        if self._lease is not None:
            self._lease.release()
        self._stop(reason)
        time.sleep(GRACE_S)
        write_error(f"{reason}; this process did not end within {GRACE_S:g} s and is killed")
        os._exit(1)


class KeyLease:
    """A key that was copied to this host for this process; it is removed at exit, or when the launcher is lost."""

    def __init__(self, folder: Path) -> None:
        self._key = folder / KEY
        self._stamp = _stamp(self._key)
        atexit.register(self.release)

    def release(self) -> None:
        """Remove the key, but not a newer one at its path, which belongs to the process's successor."""
        with contextlib.suppress(OSError):
            if _stamp(self._key) == self._stamp:
                self._key.unlink(missing_ok=True)


def key_lease(identity: Identity, launched: str | None) -> KeyLease | None:
    """Return a lease on the key that a run's launcher has copied here; None if the key is this host's own."""
    folder = identity.tls
    if launched is None or folder is None or folder.parts[-3:-1] != (launched, FOLDER):
        return None
    return KeyLease(folder)


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return inode and change time [ns], which tell a file from a newer one at its path; None if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_ctime_ns


@contextmanager
def handled_by(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Handle SIGINT and SIGTERM with a function for the duration of the `with` block."""
    previous_handlers = {number: signal.signal(number, handler) for number in REASONS}
    try:
        yield
    finally:
        for number, previous in previous_handlers.items():
            signal.signal(number, previous)


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT or SIGTERM, even if a library swallows it and raises another exception."""
    is_interrupted = False

    def on_signal(*_: object) -> None:
        nonlocal is_interrupted
        is_interrupted = True
        raise KeyboardInterrupt

    with handled_by(on_signal):
        try:
            yield
        except Exception as error:
            if is_interrupted:
                raise KeyboardInterrupt from error
            raise


def lower_priority() -> None:
    """Give the world precedence: raise the nice value of this process, and that of its session if it leads one.

    Where Linux schedules by session (autogroup), the nice values of processes apply only within a session.
    """
    if hasattr(os, "nice"):
        os.nice(NICE)
    if sys.platform != "linux" or os.getsid(0) != os.getpid():
        return
    for _ in range(TRIES):
        try:
            AUTOGROUP.write_text(str(NICE))
        except BlockingIOError:
            time.sleep(AGAIN_S)
        except OSError:
            return  # no autogroups here, or no permission
        else:
            return
