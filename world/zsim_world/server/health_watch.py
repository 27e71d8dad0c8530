"""Who has fallen silent: a process whose health has not come for so long that it is stopped, or its host gone."""

from collections.abc import Callable

SILENT_NS = 1_800_000_000  # wall time without health, which comes once a second; so a stop is named within 2 s
STALL_NS = 300_000_000  # wall time between two looks from which on the world itself was held up, or its machine


class HealthWatch:
    """Keeps when each process has last published its health.

    Args:
        handle_silence: called with name and wall time of its last health when a process falls silent, and with None
            for that when its health comes again.
    """

    def __init__(self, handle_silence: Callable[[str, int | None], None]) -> None:
        self._handle_silence = handle_silence
        self._last_wall_ns: dict[str, int] = {}
        self._silent: set[str] = set()
        self._look_wall_ns = 0

    def received(self, name: str, wall_ns: int) -> None:
        """Note the health of a process."""
        self._last_wall_ns[name] = wall_ns
        if name in self._silent:
            self._silent.discard(name)
            self._handle_silence(name, None)

    def forget(self, name: str) -> None:
        """Expect nothing of a process any more: it has left, or is dead."""
        self._last_wall_ns.pop(name, None)
        self._silent.discard(name)

    def look(self, wall_ns: int) -> list[str]:
        """Report who has fallen silent; return of whom health is expected. To be called all the time."""
        stall_ns = wall_ns - self._look_wall_ns
        self._look_wall_ns = wall_ns
        if stall_ns > STALL_NS:  # what came meanwhile was not read
            self._last_wall_ns = {name: last_ns + stall_ns for name, last_ns in self._last_wall_ns.items()}
        for name, last_ns in list(self._last_wall_ns.items()):
            if name not in self._silent and wall_ns - last_ns >= SILENT_NS:
                self._silent.add(name)
                self._handle_silence(name, last_ns)
        return list(self._last_wall_ns)
