"""Finished runs, a line of JSON each, on the disk before the next one is told as finished."""

import os
from pathlib import Path
from types import TracebackType

import msgspec

from zsim.errors import RunError
from zsim_analysis.sweep.results.row import Row


class Journal:
    """Appends rows; a line that was cut by the death of its writer is dropped.

    Args:
        path: of the file, made if it is not there.

    Raises:
        RunError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            whole = path.read_bytes().rfind(b"\n") + 1
            os.ftruncate(self._file, whole)
            os.lseek(self._file, whole, os.SEEK_SET)
        except OSError as error:
            raise self._fault(error) from error

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        os.close(self._file)

    def append(self, row: Row) -> None:
        """Add a row; when this returns, the row outlives the process and the machine's power.

        Raises:
            RunError: it cannot be written.
        """
        line = msgspec.json.encode(row) + b"\n"
        try:
            while line:
                line = line[os.write(self._file, line) :]
            os.fsync(self._file)
        except OSError as error:
            raise self._fault(error) from error

    def _fault(self, error: OSError) -> RunError:
        return RunError(f"{self._path}: cannot be written ({error.strerror}); what is finished so far is kept")


def read(path: Path) -> list[Row]:
    """Return the whole lines of a journal, none if there is no such file."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return []
    lines = content[: content.rfind(b"\n") + 1].splitlines()
    return [msgspec.json.decode(line) for line in lines]
