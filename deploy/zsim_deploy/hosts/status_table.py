"""What `zsim up` shows and `zsim ps` prints: one table of all processes on all hosts, kept while the run goes on."""

import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from rich.console import Console, Group
from rich.live import Live

from zsim.presentation import Column, FittedTable
from zsim.runtime.progress import Screen, cell, describe
from zsim.scenario.roles import WORLD
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.remote_process import RemoteProcess
from zsim_deploy.hosts.row_choice import RowChoice, needs_attention

FIRST_S = 1.0  # simulated; from then on it flies
SILENT_S = 1.0  # a host that has not answered for so long is shown as silent; it is asked twice a second …
ROUND_TRIPS = 2.0  # … and so many of its round trips more: over a slow link every answer takes long
WAITED_S = 0.5  # a process that is waited for longer is shown so; waiting for less is what lockstep is
SILENT_PROCESS_S = 1.8  # health comes once a second; so one that is stopped is shown within 2 s
STALE_S = 3.0  # health comes once a second; older figures are not shown
AROUND = 4  # lines of a terminal beside the rows: progress, two of the head, and how many rows are not shown
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


class StatusTable(Screen):
    """Progress of a run on several hosts; a table on a terminal, lines elsewhere.

    Attributes:
        members: the processes; to be given before it is shown.
        links: to the hosts.
        stages_s: how long each step before the processes' start took.

    Args:
        duration_s: simulated time of the run.
        console: the terminal.
        choice: which rows the live table has, in which order.
    """

    def __init__(self, duration_s: float, console: Console | None = None, choice: RowChoice | None = None) -> None:
        super().__init__(duration_s, console)
        self._choice = choice or RowChoice()
        self.members: Sequence[Any] = ()
        self.links: dict[str, HostLink] = {}
        self.stages_s: dict[str, float] = {}
        self._begun_s = time.monotonic()
        self._flies = False
        self._health: dict[str, dict[str, Any]] = {}
        self._clock: dict[str, Any] | None = None
        self._silent: set[str] = set()
        self._live = Live(get_renderable=self._render, console=self.console, refresh_per_second=4, transient=True)

    def clock(self, line: dict[str, Any]) -> None:
        self._clock = {**line, "wall_s": time.monotonic()}
        if line["t_s"] >= FIRST_S and not self._flies:
            self._flies = True
            self.say(self._start_up())
        if not self._is_live:
            super().clock(line)

    def _start_up(self) -> str:
        """Return how long it took until simulated time went on, and where it went."""
        took_s = time.monotonic() - self._begun_s
        stages_s = {**self.stages_s, "processes": took_s - sum(self.stages_s.values())}
        return f"flies after {took_s:.1f} s: " + ", ".join(f"{what} {s:.1f} s" for what, s in stages_s.items())

    def health(self, line: dict[str, Any]) -> None:
        """Take a process's health; the messages that it has taken in since the last one give its rate."""
        now_s = time.monotonic()
        former = self._health.get(line["name"])
        rate = None
        if former is not None and now_s > former["wall_s"] and line["received"] >= former["received"]:
            rate = (line["received"] - former["received"]) / (now_s - former["wall_s"])
        self._health[line["name"]] = {**line, "wall_s": now_s, "per_s": rate}

    def report_silent_hosts(self) -> None:
        """Show once which host does not answer any more, and that it is back."""
        for name, link in self.links.items():
            silent_s = link.silent_s()
            if _is_silent(link) and name not in self._silent:
                self._silent.add(name)
                roles = ", ".join(member.name for member in self.members if member.host == name)
                self.say(f"host {name} does not answer (since {silent_s:.1f} s); on it: {roles or 'nothing'}")
            elif silent_s == 0.0 and name in self._silent:
                self._silent.discard(name)
                self.say(f"host {name} answers again")

    def clock_now(self) -> dict[str, Any] | None:
        """Return the last clock of the world."""
        return self._clock

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per process, for the table and for `zsim ps`."""
        return [self._row(member) for member in self.members]

    def _row(self, member: RemoteProcess) -> dict[str, Any]:
        link, health = self.links[member.host], self._health.get(member.name)
        fresh = health is not None and time.monotonic() - health["wall_s"] < STALE_S
        return {
            "role": member.name,
            "host": member.host,
            "pid": member.pid or None,
            "state": self._state(member, link),
            "age_s": self._age_s(member.name),
            "lag_ms": health["lag_ns"] / 1e6 if health and fresh else None,
            "messages_per_s": health["per_s"] if health and fresh else None,
            "round_trip_ms": 1e3 * link.round_trip_s if link.answered_s and not _is_silent(link) else None,
            "restarts": member.restarts,
        }

    def _age_s(self, name: str) -> float | None:
        """Return for how long nothing has come of a process [s, wall], None if nothing ever has."""
        last_s = self._health[name]["wall_s"] if name in self._health else None
        if name == WORLD and self._clock is not None:
            last_s = max(last_s or 0.0, self._clock["wall_s"])
        return None if last_s is None else time.monotonic() - last_s

    def _state(self, member: RemoteProcess, link: HostLink) -> str:
        if member.state == "running" and _is_silent(link):
            return f"host silent {link.silent_s():.0f} s"
        if member.state == "running" and (silent_s := self._no_sign_s(member.name, link)):
            return f"no sign of life for {silent_s:.0f} s"
        waited = [w for w in (self._clock or {}).get("waiting_for", ()) if w["name"] == member.name]
        if member.state == "running" and waited and waited[0].get("held_by"):
            return f"waits for {', '.join(waited[0]['held_by'])}"
        if member.state == "running" and waited and waited[0]["since_wall_s"] > WAITED_S:
            return f"waited for {waited[0]['since_wall_s']:.0f} s"
        return f"ended ({member.outcome()})" if member.state == "ended" and member.code else member.state

    def _no_sign_s(self, name: str, link: HostLink) -> float:
        """Return for how long a process has been silent, 0 where that is not long [s, wall].

        All that is known of the others comes from the world: while that is silent only it is known to be.
        """
        now_s, patience_s = time.monotonic(), SILENT_PROCESS_S + ROUND_TRIPS * link.round_trip_s
        heard_s = self._health[name]["wall_s"] if name in self._health else None
        world_s = max([health["wall_s"] for health in self._health.values()], default=now_s)
        world_s = max(world_s, (self._clock or {}).get("wall_s", world_s))
        last_s = world_s if name == WORLD else heard_s if now_s - world_s < patience_s else None
        silent_s = 0.0 if last_s is None else now_s - last_s
        return silent_s if silent_s >= patience_s else 0.0

    def _render(self) -> Group:
        clock = self._clock
        head = cell(describe(clock, self._duration_s) if clock else "starting …")
        rows = self._choice.of(self.rows())
        lines = max(1, self.console.height - AROUND)
        if len(rows) <= lines:
            return Group(head, table(rows, one_line=True))
        first = rows if self._choice.sort else sorted(rows, key=needs_attention)
        return Group(head, table(first[:lines], one_line=True), cell(_more(first[lines:])))


def _more(rows: Sequence[dict[str, Any]]) -> str:
    """Return what is known of rows that a terminal has no lines for."""
    states = Counter(row["state"] for row in rows)
    counted = ", ".join(f"{count} {state}" for state, count in states.most_common(3))
    return f"… and {len(rows)} more: {counted}{', …' if len(states) > 3 else ''}; `zsim ps` shows all"


def _is_silent(link: HostLink) -> bool:
    return link.silent_s() > SILENT_S + ROUND_TRIPS * link.round_trip_s


def table(rows: Sequence[dict[str, Any]], one_line: bool = False) -> FittedTable:
    """Return the rows as a table for people; `one_line`: what a line has no room for is cut."""
    return FittedTable(COLUMNS, [_cells(row) for row in rows], one_line=one_line)


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    return (
        row["role"],
        row["host"],
        str(row["pid"] or "-"),
        row["state"],  # it may hold output of a process
        _figure(row["lag_ms"], "{:.0f} ms"),
        _figure(row.get("age_s"), "{:.1f} s"),
        _figure(row["messages_per_s"], "{:.0f}"),
        _figure(row["round_trip_ms"], "{:.1f} ms"),
        str(row["restarts"]),
    )


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)
