"""The table of the processes on all hosts that `zsim up` shows and `zsim ps` prints."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.console import Console, Group
from rich.live import Live

from zsim.errors import RunError
from zsim.presentation import Column, FittedTable
from zsim.runtime.progress import Screen, cell, describe
from zsim.scenario.roles import WORLD
from zsim_deploy.arguments import RowOrder
from zsim_deploy.launch.supervisor import status_row

if TYPE_CHECKING:
    from zsim_deploy.hosts.host_link import HostLink

FIRST_S = 1.0  # simulated time from which the run is reported as flying
SILENT_S = 1.0  # wall time without an answer after which a host is shown as silent; it is probed twice a second …
ROUND_TRIPS = 2.0  # … plus this many of its round trips, because over a slow link every answer takes long
WAITED_S = 0.5  # wall time after which a wait for a process is shown; shorter waits are normal in lockstep
SILENT_PROCESS_S = 1.8  # wall time of silence; health arrives once a second, so a stopped process is shown within 2 s
STALE_S = 3.0  # wall time after which a process's health is no longer shown; it arrives once a second
AROUND = 4  # lines of a terminal besides the rows: progress, two of the table's head, and the count of hidden rows
NAMED_MAX = 8  # maximum number of roles named in an error
LONGEST_S = float("inf")  # age and lag of a process that has sent no health yet, so that it is shown first
ATTENTION = (  # prefixes of states, the most urgent first; all other states follow, and NOTHING_AMISS comes last
    "ended (",
    "lost",
    "no sign of life",
    "host silent",
    "waited for",
    "waits for",
)
NOTHING_AMISS = ("running", "ended")
NUMBERS = {  # by sort key, for descending order: field of a row, and the value in place of an unknown one
    "age": ("age_s", LONGEST_S),
    "lag": ("lag_ms", LONGEST_S),
    "messages": ("messages_per_s", 0.0),
    "restarts": ("restarts", 0.0),
}
COLUMNS = (
    Column("role", "name"),
    Column("host", "name"),
    Column("pid", worth=3, right=True),
    Column("state", "text"),
    Column("lag", worth=5, right=True),
    Column("age", worth=6, right=True),
    Column("msg/s", worth=2, right=True),
    Column("round\ntrip", worth=1, right=True),
    Column("re-\nstarts", worth=4, right=True),
)
Row = Mapping[str, Any]


class StatusTable(Screen):
    """Progress of a run on several hosts: a table of the chosen rows on a terminal, lines elsewhere."""

    def __init__(self, duration_s: float, console: Console | None = None, choice: "RowChoice | None" = None) -> None:
        super().__init__(duration_s, console)
        self._choice = choice or RowChoice()
        self.members: Sequence[Any] = ()  # must be set before the table is shown
        self.links: dict[str, HostLink] = {}
        self.stages_s: dict[str, float] = {}  # wall time of each step before the start of the processes, by name
        self._begun_s = time.monotonic()
        self._flies = False
        self._health: dict[str, dict[str, Any]] = {}
        self.clock_now: dict[str, Any] | None = None  # the world's last clock line
        self._silent: set[str] = set()
        self._live = Live(get_renderable=self._render, console=self.console, refresh_per_second=4, transient=True)

    def clock(self, line: dict[str, Any]) -> None:
        self.clock_now = {**line, "wall_s": time.monotonic()}
        if line["t_s"] >= FIRST_S and not self._flies:
            self._flies = True
            took_s = time.monotonic() - self._begun_s
            stages_s = {**self.stages_s, "processes": took_s - sum(self.stages_s.values())}
            self.say(f"flying after {took_s:.1f} s: " + ", ".join(f"{step} {s:.1f} s" for step, s in stages_s.items()))
        if not self._is_live:
            super().clock(line)

    def health(self, line: dict[str, Any]) -> None:
        """Store the health of a process, with its message rate since the previous health."""
        now_s = time.monotonic()
        previous = self._health.get(line["name"])
        rate = None
        if previous is not None and now_s > previous["wall_s"] and line["received"] >= previous["received"]:
            rate = (line["received"] - previous["received"]) / (now_s - previous["wall_s"])
        self._health[line["name"]] = {**line, "wall_s": now_s, "per_s": rate}

    def report_silent_hosts(self) -> None:
        """Report each host once when it stops answering, and once when it answers again."""
        for name, link in self.links.items():
            silent_s = link.silent_s()
            if _is_silent(link) and name not in self._silent:
                self._silent.add(name)
                roles = ", ".join(member.name for member in self.members if member.host == name)
                self.say(f"host {name} does not answer (silent for {silent_s:.1f} s); on it: {roles or 'nothing'}")
            elif silent_s == 0.0 and name in self._silent:
                self._silent.discard(name)
                self.say(f"host {name} answers again")

    def rows(self) -> list[dict[str, Any]]:
        rows, now_s = [], time.monotonic()
        for member in self.members:
            link, health = self.links.get(member.host), self._health.get(member.name)
            last_s = health["wall_s"] if health else None
            if member.name == WORLD and self.clock_now is not None:
                last_s = max(last_s or 0.0, self.clock_now["wall_s"])
            row = status_row(member.name, member.host, member.pid, self._state(member, link), member.restarts)
            row["age_s"] = None if last_s is None else now_s - last_s  # time since the last sign of life
            if health and now_s - health["wall_s"] < STALE_S:
                row |= {"lag_ms": health["lag_ns"] / 1e6, "messages_per_s": health["per_s"]}
            if link and link.answered_s and not _is_silent(link):
                row["round_trip_ms"] = 1e3 * link.round_trip_s
            rows.append(row)
        return rows

    def _state(self, member: Any, link: "HostLink | None") -> str:
        if member.state != "running":
            return f"ended ({member.outcome()})" if member.state == "ended" and member.code else member.state
        if link and _is_silent(link):
            return f"host silent {link.silent_s():.0f} s"
        if silent_s := self._no_sign_s(member.name, link.round_trip_s if link else 0.0):
            return f"no sign of life for {silent_s:.0f} s"
        waiting = (self.clock_now or {}).get("waiting_for", ())
        waiting_entry = next((each for each in waiting if each["name"] == member.name), None)
        if waiting_entry and waiting_entry.get("held_by"):
            return f"waits for {', '.join(waiting_entry['held_by'])}"
        if waiting_entry and waiting_entry["since_wall_s"] > WAITED_S:
            return f"waited for {waiting_entry['since_wall_s']:.0f} s"
        return member.state

    def _no_sign_s(self, name: str, round_trip_s: float) -> float:
        """Return how long a process has been silent [s, wall]; 0 if that is not unusually long.

        The health of all other processes arrives through the world; while the world is silent, only that is reported.
        """
        now_s, patience_s = time.monotonic(), SILENT_PROCESS_S + ROUND_TRIPS * round_trip_s
        heard_s = self._health[name]["wall_s"] if name in self._health else None
        world_s = max([health["wall_s"] for health in self._health.values()], default=now_s)
        world_s = max(world_s, (self.clock_now or {}).get("wall_s", world_s))
        last_s = world_s if name == WORLD else heard_s if now_s - world_s < patience_s else None
        silent_s = 0.0 if last_s is None else now_s - last_s
        return silent_s if silent_s >= patience_s else 0.0

    def _render(self) -> Group:
        clock = self.clock_now
        head = cell(describe(clock, self._duration_s) if clock else "starting …")
        rows = self._choice.select(self.rows())
        lines = max(1, self.console.height - AROUND)
        if len(rows) <= lines:
            return Group(head, table(rows, one_line=True))
        first = rows if self._choice.sort else sorted(rows, key=needs_attention)
        states = Counter(row["state"] for row in first[lines:])
        summary = ", ".join(f"{count} {state}" for state, count in states.most_common(3))
        hidden_text = (
            f"… and {len(first) - lines} more: {summary}{', …' if len(states) > 3 else ''}; `zsim ps` shows all"
        )
        return Group(head, table(first[:lines], one_line=True), cell(hidden_text))


def _is_silent(link: "HostLink") -> bool:
    return link.silent_s() > SILENT_S + ROUND_TRIPS * link.round_trip_s


def table(rows: Sequence[dict[str, Any]], one_line: bool = False) -> FittedTable:
    """Return the rows as a table; `one_line`: each row has one line, and text that does not fit is cut."""
    cells = [
        (
            row["role"],
            row["host"],
            str(row["pid"] or "-"),
            row["state"],
            _number(row["lag_ms"], "{:.0f} ms"),
            _number(row.get("age_s"), "{:.1f} s"),
            _number(row["messages_per_s"], "{:.0f}"),
            _number(row["round_trip_ms"], "{:.1f} ms"),
            str(row["restarts"]),
        )
        for row in rows
    ]
    return FittedTable(COLUMNS, cells, one_line=one_line)


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


class RowChoice(NamedTuple):
    """Which rows are shown, and in what order."""

    only: Sequence[str] = ()  # patterns of roles (`estimator.*2`), drones, formations or hosts; empty: all rows
    sort: RowOrder | None = None  # None: in the order of the processes

    def select(self, rows: Sequence[Row]) -> list[Any]:
        """Return the selected rows, in a stable order."""
        selected = [row for row in rows if not self.only or any(_matches(pattern, row) for pattern in self.only)]
        if self.sort is None:
            return selected
        sort_key = self.sort.value
        if self.sort is RowOrder.ATTENTION:
            return sorted(selected, key=needs_attention)
        if sort_key not in NUMBERS:
            return sorted(selected, key=lambda row: row[sort_key])
        field, unknown = NUMBERS[sort_key]
        return sorted(selected, key=lambda row: -(unknown if row.get(field) is None else row[field]))

    def check(self, rows: Sequence[Row]) -> None:
        """Raise RunError, naming some of the roles, if a pattern matches no row."""
        for pattern in self.only:
            if not any(_matches(pattern, row) for row in rows):
                roles = [row["role"] for row in rows]
                omitted = [f"and {len(roles) - NAMED_MAX} more"] if len(roles) > NAMED_MAX else []
                names = ", ".join([*roles[:NAMED_MAX], *omitted]) or "none"
                raise RunError(f"role is {pattern!r}; must match a role, its drone or formation, or a host: {names}")


def _matches(pattern: str, row: Row) -> bool:
    thing = row["role"].partition(".")[2]
    return any(fnmatchcase(name, pattern) for name in (row["role"], thing, row["host"]) if name)


def needs_attention(row: Row) -> int:
    """Return the rank of a row by the urgency of its state; 0 is the most urgent."""
    state = row["state"]
    if state in NOTHING_AMISS:
        return len(ATTENTION) + 1 + NOTHING_AMISS.index(state)
    return next((rank for rank, begins in enumerate(ATTENTION) if state.startswith(begins)), len(ATTENTION))
