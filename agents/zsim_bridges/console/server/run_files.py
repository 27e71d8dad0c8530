"""What a run leaves behind, as pages show it: links while the console is there, and copies once it is to leave."""

import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from zsim.output_folder import RECORD

LOOKED_S = 5.0  # wall; a page that has not looked for so long is closed; above GONE_MS + LOOK_MS of head_bar.html
MTIME_S = 2.0  # by so much a file's time may be too early, at most: that of FAT
POLL_S = 0.1  # wall; between two looks at whether all pages have their copies
LOOKS_MAX = 200  # that are kept: more than there may be pages open, 50 of operators and 50 of viewers


class RunFiles:
    """The report and the record of one run, as far as they were written since this was made: others are of another run.

    Args:
        folder: of the run; None where that is not known here.

    Attributes:
        paths: by the names that pages have for them; the files may not be there yet.
    """

    def __init__(self, folder: Path | None) -> None:
        whole = folder and folder.absolute()
        self.paths = {"report": whole / "report.html", "record": whole / RECORD} if whole else {}
        self._since_s = time.time()
        self._looked_s: dict[str, float] = {}  # when pages without copies last looked (monotonic, wall), by their names
        self._leaves = False

    def shown(self, page: str, has_copies: bool) -> dict[str, Any]:
        """Return what the head of a page shows of them, as plain data.

        Args:
            page: its name; empty where no page asks.
            has_copies: whether it has taken all that it wants to keep.
        """
        if page and not has_copies:
            self._note_look(page)
        else:
            self._looked_s.pop(page, None)
        files = {name: {"path": str(path), "size_bytes": self.size_bytes(path)} for name, path in self.paths.items()}
        return {"files": files, "leaves": self._leaves}

    def _note_look(self, page: str) -> None:
        while len(self._looked_s) >= LOOKS_MAX and page not in self._looked_s:
            del self._looked_s[min(self._looked_s, key=self._looked_s.__getitem__)]
        self._looked_s[page] = time.monotonic()

    def offer(self, within_s: float, deserted: Callable[[], bool]) -> None:
        """Let pages copy the files, since nobody will serve them any more; return when none that is open lacks any.

        Args:
            within_s: how long that may take [wall].
            deserted: whether to return at once.
        """
        self._leaves = True
        until_s = time.monotonic() + within_s
        while time.monotonic() < until_s and self._has_open_page() and not deserted():
            time.sleep(POLL_S)

    def _has_open_page(self) -> bool:
        return any(time.monotonic() - looked_s < LOOKED_S for looked_s in list(self._looked_s.values()))

    def size_bytes(self, path: Path) -> int | None:
        """Return the size of one of the files, None where this run has not written it."""
        try:
            status = path.stat()
        except OSError:
            return None
        is_own = stat.S_ISREG(status.st_mode) and status.st_mtime >= self._since_s - MTIME_S
        return status.st_size if is_own else None
