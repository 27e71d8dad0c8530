"""A background process that reports when it is ready, and whose output is kept in a file."""

import subprocess
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

READY_S = 120.0  # wall time to become ready on a loaded machine


class Service:
    """A started process, ready to serve.

    Args:
        ready: text that it prints once it is ready.
        log: file for its output.

    Raises:
        OSError: it ended, or was not ready in time.
    """

    def __init__(self, command: Sequence[str], ready: str, log: Path, env: Mapping[str, str]) -> None:
        self._process = subprocess.Popen(
            command, text=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=env
        )
        self._ready, self._log = ready, log
        self._settled = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        if not self._settled.wait(READY_S) or self._process.poll() is not None:
            self.kill()
            raise OSError(f"{command[-1]}: no {ready!r} within {READY_S:g} s; it says {log.read_text()[-400:]!r}")

    def kill(self) -> None:
        """End the process; its children may live on and write output."""
        self._process.kill()
        self._process.wait()

    def finish(self) -> None:
        """Read the rest of the output, until all processes that write it have ended."""
        self._process.wait()
        self._reader.join()

    def _read(self) -> None:
        assert self._process.stdout
        with self._process.stdout as printed, self._log.open("a") as kept:
            for line in printed:
                kept.write(line)
                kept.flush()
                if self._ready in line:
                    self._settled.set()
        self._settled.set()
