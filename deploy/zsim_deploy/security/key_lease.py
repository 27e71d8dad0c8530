"""The private key that `zsim up` lends to a process on another host: it goes from there with the process."""

import atexit
import contextlib
from pathlib import Path

from zsim.transport.tls import KEY, Identity

FOLDER = "identity"  # in the folder of a run on a host; the certificates of its processes are below


class Lent:
    """A key that was brought for this process; it is given back when the process ends, however that comes.

    Args:
        folder: with the key.
    """

    def __init__(self, folder: Path) -> None:
        self._key = folder / KEY
        self._stamp = _stamp(self._key)
        atexit.register(self.give_back)

    def give_back(self) -> None:
        """Remove the key, but not one that was brought to its place since, for whoever takes over."""
        with contextlib.suppress(OSError):
            if _stamp(self._key) == self._stamp:
                self._key.unlink(missing_ok=True)


def lent(identity: Identity, launched: str | None) -> Lent | None:
    """Return the key that the launcher of a run has lent; None if the key is this host's own, or there is none."""
    folder = identity.tls
    if launched is None or folder is None or folder.parts[-3:-1] != (launched, FOLDER):
        return None
    return Lent(folder)


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return what tells a file from another one at its place."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_ctime_ns
