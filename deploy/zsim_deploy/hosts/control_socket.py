"""The local socket through which `zsim ps`, `logs`, `restart`, `move` and `down` reach the launcher on this machine.

A connection carries one request and one answer, a JSON line each: {op, args} and {ok, error, result}.
"""

import contextlib
import inspect
import json
import os
import socket
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from zsim import __version__
from zsim.errors import RunError, ZsimError, file_fault
from zsim.output_folder import no_locks, take_lock
from zsim_deploy.arguments import note

REQUEST_S = 5.0  # wall time for a request to arrive, from the same machine
ANSWER_S = 150.0  # wall time for an answer; a move, with a connection, checks and a copy, takes 135 s at most
LINE_MAX = 1_000_000  # maximum length of a request [bytes]
PATH_MAX = 107  # maximum length of a socket path on Linux, without the final zero [bytes]; unix(7). On macOS it is 103

Act = Callable[..., Any]


def place(federation: str) -> Path:
    """Return the socket path of a federation's launcher; only the launcher's user can connect to it.

    Raise RunError on Windows, which has no such sockets.
    """
    if not hasattr(socket, "AF_UNIX") or not hasattr(os, "getuid"):
        raise RunError("launchers are reached through Unix sockets, which this system lacks; use Linux or WSL")
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(runtime) / "zsim" if runtime else Path(tempfile.gettempdir()) / f"zsim-{os.getuid()}"
    return folder / f"{federation}.sock"


def launchers() -> list[str]:
    """Return the names of this user's launchers on this machine: FEDERATION of `zsim up`, FEDERATION@PID of `zsim run`.

    The sockets of killed launchers of `zsim run` are removed.
    """
    names = []
    for path in sorted(place("").parent.glob("*.sock")):
        _, is_of_run, pid = path.stem.partition("@")
        try:
            if is_of_run:
                os.kill(int(pid), 0)  # raises if there is no such process
            names.append(path.stem)
        except (OSError, ValueError):
            path.unlink(missing_ok=True)
            path.with_suffix(".lock").unlink(missing_ok=True)
    return names


def ask(federation: str, op: str, **args: Any) -> Any:
    """Send a request to a federation's launcher on this machine, and return the result.

    Raise RunError if no launcher is running, or if it does not answer or refuses the request.
    """
    path = place(federation)
    with socket.socket(socket.AF_UNIX) as line:
        line.settimeout(ANSWER_S)
        try:
            line.connect(str(path))
        except OSError as error:
            raise RunError(
                f"no `zsim up` of federation {federation!r} is running on this machine; start one"
            ) from error
        _refuse_if_foreign(path.parent)
        try:
            line.sendall(json.dumps({"op": op, "args": args}).encode() + b"\n")
            with line.makefile("rb") as stream:
                answer = json.loads(stream.readline())
        except TimeoutError as error:
            raise RunError(f"`zsim up` has not answered {op} within {ANSWER_S:g} s; check its terminal") from error
        except (OSError, ValueError) as error:
            raise RunError(f"`zsim up` ended before it answered {op}") from error
    if not answer["ok"]:
        raise RunError(answer["error"])
    return answer["result"]


@contextlib.contextmanager
def seen_by_ps(federation: str, status: Callable[[], dict[str, Any]]) -> Iterator[None]:
    """Show a run of this process in `zsim ps` for the duration of the block, if a socket can be opened."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(RunError):
            name = f"{federation}@{os.getpid()}"  # a federation may have several runs
            stack.enter_context(ControlSocket(name, {"ps": status}))
        yield


class ControlSocket:
    """The launcher's end of the control socket; a context manager.

    Args:
        actions: function for each `op`; called in a thread with the request's arguments, it returns a JSON value.

    Raises:
        RunError: another launcher of the federation is running here, or no socket can be opened.
    """

    def __init__(self, federation: str, actions: dict[str, Act]) -> None:
        self._actions = actions
        self._path = path = place(federation)
        with file_fault(path.parent, "cannot be created", "set XDG_RUNTIME_DIR to a folder of yours"):
            path.parent.mkdir(mode=0o700, exist_ok=True)
        _refuse_if_foreign(path.parent)
        lock = path.with_suffix(".lock")  # held while the launcher lives, and released however it ends
        with file_fault(lock, "cannot be created", "set XDG_RUNTIME_DIR to another folder"):
            self._lock = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        if not take_lock(self._lock):
            os.close(self._lock)
            raise RunError(
                f"federation {federation!r} is already up on this machine; end it with "
                f"`zsim down --federation {federation}`, or fly in another one: --set federation=NAME"
            )
        if "@" not in path.stem and (warning := no_locks(path.parent)):  # the name of a `zsim run` is unique
            note(warning)
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            path.unlink(missing_ok=True)  # left by a killed launcher, since we hold its lock
            self._socket.bind(str(path))
            self._socket.listen()
        except OSError as error:
            self._socket.close()
            os.close(self._lock)
            is_long = len(os.fsencode(path)) > PATH_MAX
            reason = f"the path is longer than {PATH_MAX} bytes; set XDG_RUNTIME_DIR or TMPDIR to a shorter one"
            raise RunError(f"{path}: cannot listen on it ({reason if is_long else error.strerror or error})") from error
        self._thread = threading.Thread(target=self._serve, name="control socket", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            threading.Thread(target=self._answer, args=(connection,), name="control answer", daemon=True).start()

    def _answer(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.settimeout(REQUEST_S)
            with connection.makefile("rb") as stream:
                line = stream.readline(LINE_MAX)
            answer: dict[str, Any] = {"ok": False}
            try:
                request = json.loads(line)
                action, args = self._actions[request["op"]], request.get("args", {})
                inspect.signature(action).bind(**args)
            except (ValueError, KeyError, TypeError) as error:
                remedy = "use the version of zsim that runs `zsim up`"
                answer["error"] = f"it is not a request of zsim {__version__} ({error}); {remedy}"
            else:
                try:
                    answer = {"ok": True, "result": action(**args)}
                except (ZsimError, TimeoutError) as error:
                    answer["error"] = str(error) or "it took too long"
                except Exception as error:
                    answer["error"] = f"an internal error of zsim: {error!r}"
            connection.sendall(json.dumps(answer).encode() + b"\n")

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._path.unlink(missing_ok=True)
        self._thread.join(1.0)
        os.close(self._lock)
        if "@" in self._path.stem:  # the lock of a `zsim run`, which no other launcher uses
            self._path.with_suffix(".lock").unlink(missing_ok=True)

    def __enter__(self) -> "ControlSocket":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _refuse_if_foreign(folder: Path) -> None:
    """Raise RunError for a folder in which another user could open a socket in our place."""
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise RunError(
            f"{folder}: is not your private folder (owner {status.st_uid}, mode {status.st_mode & 0o777:o}); "
            f"must belong to user {os.getuid()}, with mode 700; remove it, or set XDG_RUNTIME_DIR to a folder of yours"
        )
