"""What a process on another host says, kept in a file here."""

from collections.abc import Callable
from pathlib import Path


class Log:
    """A file of lines; where it cannot be written, that is said once, and only the last line is kept.

    Args:
        path: of the file, named after the process.
        say: told when it cannot be written.

    Attributes:
        last: line that is not empty.
    """

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self.last = ""
        self._path = path
        self._say = say
        self._is_whole = True

    def write(self, line: str) -> None:
        """Add a line, which ends in a line feed."""
        self.last = line.strip() or self.last
        try:
            with self._path.open("a", errors="replace") as file:
                file.write(line)
        except OSError as error:
            if self._is_whole:
                self._is_whole = False
                self._say(f"{self._path}: cannot be written ({error.strerror}); what it would say there is lost")
