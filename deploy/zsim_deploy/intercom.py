"""How `zsim ps`, `logs`, `restart`, `move` and `down` reach the `zsim up` that runs on this machine: a local socket.

One request and one answer per connection, a JSON line each: {op, args} and {ok, error, result}.
"""

import contextlib
import json
import os
import socket
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from zsim.errors import RunError

ANSWER_S = 15.0  # a move starts a process on another host
LINE_MAX = 1_000_000  # bytes

Act = Callable[..., Any]


def place(federation: str) -> Path:
    """Return where the launcher of a federation listens; only its user may come in."""
    return Path(tempfile.gettempdir()) / f"zsim-{os.getuid()}" / f"{federation}.sock"


class Intercom:
    """The launcher's end.

    Args:
        federation: whose launcher it is.
        acts: by name; each is called in a thread, with the request's arguments, and returns what JSON can hold.

    Raises:
        RunError: another launcher of the federation runs on this machine.
    """

    def __init__(self, federation: str, acts: dict[str, Act]) -> None:
        self._acts = acts
        self._path = place(federation)
        self._path.parent.mkdir(mode=0o700, exist_ok=True)
        if self._path.exists():
            _refuse_if_alive(federation, self._path)
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(str(self._path))
        self._socket.listen()
        self._thread = threading.Thread(target=self._serve, name="intercom", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            threading.Thread(target=self._answer, args=(connection,), name="intercom answer", daemon=True).start()

    def _answer(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.settimeout(ANSWER_S)
            line = connection.makefile("rb").readline(LINE_MAX)
            connection.sendall(json.dumps(self._carry_out(line)).encode() + b"\n")

    def _carry_out(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            act = self._acts[request["op"]]
            return {"ok": True, "result": act(**request.get("args", {}))}
        except RunError as error:
            return {"ok": False, "error": str(error)}
        except (ValueError, KeyError, TypeError) as error:
            return {"ok": False, "error": f"no request that is understood ({error}); is it another version of zsim?"}

    def close(self) -> None:
        """Answer nobody any more."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._path.unlink(missing_ok=True)
        self._thread.join(1.0)


def _refuse_if_alive(federation: str, path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            path.unlink(missing_ok=True)  # of a launcher that was killed
            return
    raise RunError(f"federation {federation!r} is up already on this machine; end it with `zsim down`, or name another")


def ask(federation: str, op: str, **args: Any) -> Any:
    """Ask the launcher of a federation on this machine.

    Raises:
        RunError: nobody is up, or it refuses; with its reason.
    """
    with socket.socket(socket.AF_UNIX) as line:
        line.settimeout(ANSWER_S)
        try:
            line.connect(str(place(federation)))
            line.sendall(json.dumps({"op": op, "args": args}).encode() + b"\n")
            answer = json.loads(line.makefile("rb").readline())
        except (OSError, ValueError) as error:
            raise RunError(f"no `zsim up` of federation {federation!r} runs on this machine; start one") from error
    if not answer["ok"]:
        raise RunError(answer["error"])
    return answer["result"]
