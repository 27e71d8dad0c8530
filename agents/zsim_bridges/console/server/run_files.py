"""What a run leaves behind, as pages show it: links while the console is there, and copies once it is to leave."""

import time
from pathlib import Path
from typing import Any

from zsim.record.record_reader import RECORD

LOOKED_S = 3.0  # wall; a page that has not looked for so long is closed: it looks twice a second, a slow one less
POLL_S = 0.1  # wall; between two looks at whether all pages have their copies
PAGES_MAX = 200  # whose looks are kept


class RunFiles:
    """The report and the record of one run.

    Args:
        folder: of the run; None where that is not known here.

    Attributes:
        paths: by the names that pages have for them; the files may not be there yet.
    """

    def __init__(self, folder: Path | None) -> None:
        whole = folder and folder.absolute()
        self.paths = {"report": whole / "report.html", "record": whole / RECORD} if whole else {}
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
        files = {name: {"path": str(path), "size_bytes": _size(path)} for name, path in self.paths.items()}
        return {"files": files, "leaves": self._leaves}

    def _note_look(self, page: str) -> None:
        while len(self._looked_s) >= PAGES_MAX and page not in self._looked_s:
            del self._looked_s[min(self._looked_s, key=self._looked_s.__getitem__)]
        self._looked_s[page] = time.monotonic()

    def offer(self, within_s: float) -> None:
        """Let pages copy the files, since nobody will serve them any more; return when none that is open lacks any."""
        self._leaves = True
        until_s = time.monotonic() + within_s
        while time.monotonic() < until_s and self._has_open_page():
            time.sleep(POLL_S)

    def _has_open_page(self) -> bool:
        return any(time.monotonic() - looked_s < LOOKED_S for looked_s in list(self._looked_s.values()))


def _size(path: Path) -> int | None:
    """Return the size of a file, None where there is none."""
    try:
        return path.stat().st_size if path.is_file() else None
    except OSError:
        return None
