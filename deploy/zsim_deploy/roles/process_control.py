"""How a process is stopped: by a signal, by its launcher, or because the launcher has died.

A launched process has a pipe from its launcher as standard input. The launcher writes "stop REASON"; when it dies,
the pipe ends. So nothing outlives its launcher, on any system, also after kill -9. A launcher on another host writes
"orphan-after SECONDS" and then a "beat" every second: a host that vanishes closes no pipe. A launched process that is
sent SIGTERM instead ends in order, too, but counts as dead: its launcher did not ask for it.

With the process ends the lease of the private key that `zsim up` has copied to its host.
"""

import atexit
import contextlib
import io
import os
import select
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from zsim.transport.tls import KEY, Identity
from zsim_deploy import INTERRUPTED

REASONS: dict[int, str] = {signal.SIGINT: "interrupted by Ctrl-C", signal.SIGTERM: "terminated"}
HANGUP = (signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()  # not on Windows
TWICE_INTERRUPTED = "interrupted twice, nobody was waited for"
TERMINATED = 128 + signal.SIGTERM  # exit code, as shells have it
GRACE_S = 4.0  # a role that hangs after a request to stop is ended; the world waits 5 s for byes only if unstopped
FOLDER = "identity"  # in the folder of a run on a host; the certificates of its processes are below


@contextmanager
def handled_by(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Hand these signals to a function, and afterwards to whom they went before."""
    former = {number: signal.signal(number, handler) for number in REASONS}
    try:
        yield
    finally:
        for number, before in former.items():
            signal.signal(number, before)


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt at these signals, also where a library in between loses it and fails in another way."""
    asked = False

    def on_signal(*_: object) -> None:
        nonlocal asked
        asked = True
        raise KeyboardInterrupt

    with handled_by(on_signal):
        try:
            yield
        except Exception as error:
            if asked:
                raise KeyboardInterrupt from error
            raise


class KeyLease:
    """A key that was copied to this host for this process; it is removed when the process ends, for whatever reason.

    Args:
        folder: with the key.
    """

    def __init__(self, folder: Path) -> None:
        self._key = folder / KEY
        self._stamp = _stamp(self._key)
        atexit.register(self.release)

    def release(self) -> None:
        """Remove the key, but not a newer one at its path: that is of the process that takes over."""
        with contextlib.suppress(OSError):
            if _stamp(self._key) == self._stamp:
                self._key.unlink(missing_ok=True)


class StopChannel:
    """The reason to stop, once there is one.

    Args:
        launched: run of which the process is a part. Then standard input is its launcher's pipe, and Ctrl-C is left to
            the launcher. None if it was started by hand.
        identity: whose key is removed as soon as the launcher is gone, if it is leased.
    """

    def __init__(self, launched: str | None = None, identity: Identity | None = None) -> None:
        self._lease = key_lease(identity, launched) if identity else None
        self._reason: str | None = None
        self._orphaned = self._terminated = False
        self._last_line_s = time.monotonic()
        self._former = {number: signal.getsignal(number) for number in (*REASONS, *HANGUP)}
        if launched is not None:
            handlers = {signal.SIGTERM: self._on_kill, signal.SIGINT: signal.SIG_IGN}
            threading.Thread(target=self._read, name="stop channel", daemon=True).start()
        else:
            handlers = {signal.SIGTERM: self._on_term, signal.SIGINT: self._on_interrupt}
            handlers |= dict.fromkeys(filter(_is_nobodys, HANGUP), self._on_hangup)
        for number, handler in handlers.items():
            signal.signal(number, handler)

    def reason(self) -> str | None:
        """Return why to stop, None to go on."""
        return self._reason

    def stopped(self) -> bool:
        """Return whether to stop."""
        return self._reason is not None

    def orphaned(self) -> bool:
        """Return whether the launcher is gone, or does not want this end: for all others it is a death, no leave."""
        return self._orphaned

    def exit_if_terminated(self) -> None:
        """Tell the launcher, by the exit code, that somebody else has ended this process; to be called last.

        Raises:
            SystemExit: that is so.
        """
        if self._terminated:
            raise SystemExit(TERMINATED)

    def restore_signals(self) -> None:
        """Take no signals any more: what is left to do may be interrupted as anything."""
        for number, handler in self._former.items():
            signal.signal(number, handler)

    def _stop(self, reason: str) -> None:
        self._reason = self._reason or reason

    def _on_kill(self, *_: object) -> None:
        if self._reason is None:
            self._orphaned = self._terminated = True
        self._stop(REASONS[signal.SIGTERM])

    def _on_term(self, *_: object) -> None:
        self._stop(REASONS[signal.SIGTERM])

    def _on_hangup(self, *_: object) -> None:
        """End as after SIGTERM, and write nothing more to what may be gone."""
        redirect_output(Path(os.devnull))
        self._stop(CLOSED)

    def _on_interrupt(self, *_: object) -> None:
        if self._reason is not None:
            write_error(TWICE_INTERRUPTED)
            os._exit(INTERRUPTED)
        self._stop(REASONS[signal.SIGINT])

    def _read(self) -> None:
        for line in sys.stdin:
            self._last_line_s = time.monotonic()
            word, _, rest = line.strip().partition(" ")
            if word == "stop":
                self._stop(rest or "stopped by the launcher")
            elif word == "orphan-after":
                threading.Thread(target=self._await_beats, args=(float(rest),), name="beats", daemon=True).start()
        self._leave("the launcher is gone")

    def _await_beats(self, limit_s: float) -> None:
        """End this process when nothing has come for so long."""
        while (left_s := self._last_line_s + limit_s - time.monotonic()) > 0:
            time.sleep(left_s)
        self._leave(f"nothing came from the launcher for {limit_s:g} s")

    def _leave(self, reason: str) -> None:
        self._orphaned = True
        if self._lease is not None:
            self._lease.release()
        self._stop(reason)
        time.sleep(GRACE_S)
        write_error(f"{reason}; this process did not end within {GRACE_S:g} s and is ended")
        os._exit(1)


def key_lease(identity: Identity, launched: str | None) -> KeyLease | None:
    """Return the lease of the key that the launcher of a run has copied here; None if the key is this host's own."""
    folder = identity.tls
    if launched is None or folder is None or folder.parts[-3:-1] != (launched, FOLDER):
        return None
    return KeyLease(folder)


def _is_nobodys(number: int) -> bool:
    """Return whether a signal would end this process at once: neither ignored, as under nohup, nor taken."""
    return signal.getsignal(number) is signal.SIG_DFL


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return what distinguishes a file from a newer one at its path."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_ctime_ns


STREAMS = 1, 2  # standard output and error
CLOSED = "the terminal was closed"


class _Output(io.FileIO):
    """A standard stream that loses what its file does not take; only that nobody is at the end of a pipe is raised."""

    _lost = False

    def write(self, data: Any, /) -> int | None:
        try:
            return super().write(data)
        except BrokenPipeError:
            raise
        except OSError as error:  # a full disk, a terminal that is gone
            if not self._lost and self.fileno() != STREAMS[-1]:
                write_error(f"standard output cannot be written ({error.strerror}); what follows is lost")
            self._lost = True
            return len(data)


def write_error(text: str) -> None:
    """Write a line to standard error without Python's stream, as from a signal handler; it may be lost."""
    with contextlib.suppress(OSError):
        os.write(STREAMS[-1], f"{text}\n".encode(errors="replace"))


def renew_streams() -> None:
    """Open Python's standard streams anew, so that nothing ends because one of them is closed, or its disk full.

    To be called before any file is opened: it would take the number of a stream that is closed, and then also what a
    library prints.
    """
    for number in (0, *STREAMS):
        try:
            os.fstat(number)
        except OSError:
            empty = os.open(os.devnull, os.O_RDWR)
            if empty != number:
                os.dup2(empty, number)
                os.close(empty)
    encodings = [getattr(stream, "encoding", None) for stream in (sys.stdin, sys.stdout, sys.stderr)]
    sys.stdin = os.fdopen(0, encoding=encodings[0], errors=getattr(sys.stdin, "errors", None), closefd=False)
    out, error = (io.BufferedWriter(_Output(number, "w", closefd=False)) for number in STREAMS)
    # a question mark for a character that the terminal's encoding lacks, rather than the end of the command
    sys.stdout = io.TextIOWrapper(out, encodings[1], "replace", line_buffering=os.isatty(STREAMS[0]))
    sys.stderr = io.TextIOWrapper(error, encodings[2], "replace", line_buffering=True)


def is_unread(stream: int) -> bool:
    """Tell whether a stream is a pipe at the end of which nobody is."""
    with contextlib.suppress(OSError):
        if stat.S_ISFIFO(os.fstat(stream).st_mode) and hasattr(select, "poll"):  # not on Windows
            poller = select.poll()
            poller.register(stream, 0)
            return bool(poller.poll(0))  # an error is reported whatever is asked for
    return False


def redirect_output(log: Path, streams: Sequence[int] = STREAMS, why: str = CLOSED) -> None:
    """Send to a file what is written from now on to a terminal or a pipe, which may take nothing any more."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
    try:
        into = os.open(log, flags, 0o644)
    except OSError:
        into = os.open(os.devnull, os.O_WRONLY)
    lost = [stream for stream in streams if not _is_file(stream)]
    if lost:
        write_error(f"{why}; what there is still to say is in {log}")
    for stream in lost:
        os.dup2(into, stream)
    os.close(into)


def _is_file(stream: int) -> bool:
    """Tell whether a stream is a file already, or is not open at all."""
    try:
        return stat.S_ISREG(os.fstat(stream).st_mode)
    except OSError:
        return True


NICE = 5  # of processes for which no gate waits
AUTOGROUP = Path("/proc/self/autogroup")  # sched(7)
TRIES = 5
AGAIN_S = 0.12  # the kernel lets ordinary users write there ten times a second, all of them together


def lower_priority() -> None:
    """Let the world go first. Threads to come, too."""
    lower(NICE)


def lower(niceness: int) -> None:
    """Make this process nicer, and with it the session that it leads, if it does.

    Where Linux shares processors between sessions, niceness counts within each of them only.
    """
    if hasattr(os, "nice"):
        os.nice(niceness)
    if sys.platform == "linux" and os.getsid(0) == os.getpid():
        _lower_session(niceness)


def _lower_session(niceness: int) -> None:
    for _ in range(TRIES):
        try:
            AUTOGROUP.write_text(str(niceness))
        except BlockingIOError:
            time.sleep(AGAIN_S)
        except OSError:
            return  # not shared that way here, or not ours to set
        else:
            return
