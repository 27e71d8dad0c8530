"""Whether the world still shows signs of life to its launcher: it cannot say itself that it is stopped."""

from typing import Any

SILENT_S = 1.8  # a world that stands still shows its clock once a second; so a stop is named within 2 s


class WorldWatch:
    """Notices when nothing comes from the world any more, and when it is back.

    Nothing is noticed before its first line: it may compile.
    """

    def __init__(self) -> None:
        self._last_s: float | None = None
        self._is_silent = False
        self._ends_for: list[str] = []

    def received(self, now_s: float) -> None:
        """Note a line of the world; callable from any thread."""
        self._last_s = now_s

    def clock(self, line: dict[str, Any]) -> None:
        """Note whom a world waits for that has ended: its links to them close only when they take what is left."""
        if line.get("state") == "stopped":
            self._ends_for = [each["name"] for each in line.get("waiting_for", ())]

    def change(self, now_s: float, pid: int) -> str | None:
        """Return the line for the user when the world has fallen silent or is back, None as long as it is as before."""
        if self._last_s is None or self._is_silent == (now_s - self._last_s >= SILENT_S):
            return None
        self._is_silent = not self._is_silent
        if not self._is_silent:
            return f"world (pid {pid}) is back"
        if self._ends_for:
            named = ", ".join(self._ends_for)
            return f"world (pid {pid}) has ended and waits for {named}: stopped, or out of reach"
        silent_s = now_s - self._last_s
        go_on = f"kill -CONT {pid} lets it go on"
        return f"world (pid {pid}) shows no sign of life for {silent_s:.1f} s: it is stopped ({go_on}) or out of reach"
