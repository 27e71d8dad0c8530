"""The table of all drones, as one page sorts and filters it, with the drones that it has selected for one command."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import viser

from zsim_agents.formation.flight_check import DOWN
from zsim_bridges.console.console_tables import DroneRow, drone_table
from zsim_bridges.console.monitoring.alarms import BATTERY_LOW_PERCENT
from zsim_bridges.console.monitoring.flight_figures import FlightFigures

MANY = 12  # drones, from which on the worst stand first unless one chooses otherwise: they do not fit on a page
FILTER_MAX = 80  # characters that are looked at
SEVERITIES = ("red", "amber", None)
ORDERS: dict[str, Callable[[DroneRow], tuple[float, ...]]] = {
    "as in the scenario": lambda _: (),
    "worst first": lambda row: (SEVERITIES.index(row.severity), row.battery_percent, -row.link_badness),
    "battery, lowest first": lambda row: (row.battery_percent,),
    "link, worst first": lambda row: (-row.link_badness,),
    "σ, largest first": lambda row: (-math.inf if row.sigma_m is None else -row.sigma_m,),
}
"""By what rows are sorted; those that are equal stay in the scenario's order."""
ALL = "all"
CHOICES: dict[str, Callable[[DroneRow, "frozenset[str]"], bool]] = {
    ALL: lambda row, selected: True,
    "with an alarm": lambda row, selected: row.severity is not None,
    "in the air": lambda row, selected: row.state not in DOWN,
    "on the ground": lambda row, selected: row.state in DOWN,
    "battery low": lambda row, selected: row.battery_percent < BATTERY_LOW_PERCENT,
    "selected": lambda row, selected: row.name in selected,
}
NO_ROW = "no drone is like that; change the filter"


class Filtered(NamedTuple):
    """How rows are sorted, and which are shown.

    Attributes:
        order: one of `ORDERS`.
        choice: one of `CHOICES`.
        text: words, each of which must be in a row: in its name, state, commander, faults or link.
    """

    order: str = next(iter(ORDERS))
    choice: str = ALL
    text: str = ""

    def rows(self, rows: Sequence[DroneRow], selected: frozenset[str] = frozenset()) -> list[DroneRow]:
        """Return the rows that are shown, in their order."""
        words = self.text[:FILTER_MAX].lower().split()
        shown = [row for row in rows if CHOICES[self.choice](row, selected) and _has(row, words)]
        return sorted(shown, key=ORDERS[self.order])


def _has(row: DroneRow, words: Sequence[str]) -> bool:
    texts = row.name, row.state.replace("_", " "), row.commander or "nobody", *row.faults, row.link[0]
    return all(any(word in text.lower() for text in texts) for word in words)


class FleetTable:
    """The table of one page.

    Args:
        gui: viser's of that page, in the folder where it is to be.
        names: of the drones.
        changed: called when others are selected.

    Attributes:
        table: the rows, as HTML.
    """

    def __init__(self, gui: viser.GuiApi, names: Sequence[str], changed: Callable[[], None]) -> None:
        self._names = tuple(names)
        self._changed = changed
        self._selected: frozenset[str] = frozenset()
        self._shown: tuple[str, ...] = self._names
        orders, are_many = list(ORDERS), len(names) > MANY
        with gui.add_folder("Sort, filter, select", expand_by_default=are_many):
            self._order = gui.add_dropdown("sort by", orders, initial_value=orders[are_many])
            self._choice = gui.add_dropdown("show", list(CHOICES))
            self._text = gui.add_text("filter", "", hint="Parts of a name, state, commander, fault or link")
            select = gui.add_button_group("select", ["all shown", "none"])
        select.on_click(lambda _: self._select_shown(select.value == "all shown"))
        self.table = gui.add_html("")

    @property
    def selected(self) -> list[str]:
        """Names of the drones that are selected, in the scenario's order."""
        return [name for name in self._names if name in self._selected]

    def toggle(self, drone: str) -> None:
        """Select a drone beside the others, or no longer."""
        if drone in self._names:
            self._select(self._selected ^ {drone})

    def show(self, rows: Sequence[DroneRow], figures: Mapping[str, FlightFigures], chosen: str) -> None:
        """Show the rows of now; `chosen` is the drone whose instruments the page shows."""
        filtered = Filtered(self._order.value, self._choice.value, self._text.value)
        shown = filtered.rows(rows, self._selected)
        self._shown = tuple(row.name for row in shown)
        self.table.content = drone_table(shown, figures, self._selected, chosen, NO_ROW if rows else "")

    def _select_shown(self, shown: bool) -> None:
        self._select(self._selected | set(self._shown) if shown else frozenset())

    def _select(self, names: frozenset[str]) -> None:
        self._selected = names
        self._changed()
