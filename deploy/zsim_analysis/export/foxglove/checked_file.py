"""A file for a library that prints what goes wrong, at every write again, rather than raise it."""

from collections.abc import Callable
from os import SEEK_CUR, SEEK_END, SEEK_SET
from pathlib import Path
from typing import Any


class Disk:
    """Takes everything; once a write has failed, nothing more goes to the disk.

    Args:
        path: of the file, new.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb")
        self._failure: OSError | None = None
        self._at = self._end = 0  # where the library believes the file to be

    def write(self, data: bytes | bytearray) -> int:
        """Take bytes; return how many."""
        self._try(self._file.write, data)
        self._at += len(data)
        self._end = max(self._end, self._at)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go to a place; return it."""
        self._try(self._file.seek, offset, whence)
        self._at = offset + {SEEK_SET: 0, SEEK_CUR: self._at, SEEK_END: self._end}[whence]
        return self._at

    def flush(self) -> None:
        """Write what is kept to be written later."""
        self._try(self._file.flush)

    def check(self) -> None:
        """Raise what went wrong.

        Raises:
            OSError: a write has failed.
        """
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """End the file.

        Raises:
            OSError: a write has failed.
        """
        self.flush()
        try:
            self._file.close()
        finally:
            self.check()

    def _try(self, act: Callable[..., object], *args: Any) -> None:
        if self._failure is None:
            try:
                act(*args)
            except OSError as error:
                self._failure = error
