"""Drones on one page: modes of the chosen drone, or of those selected for one command, and the table of all drones."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import viser

from zsim_agents.formation.flight_check import DOWN
from zsim_bridges.console.alarms import BATTERY_LOW_PERCENT
from zsim_bridges.console.command_client import CommandClient
from zsim_bridges.console.console_tables import DroneRow, drone_table, preflight_lines
from zsim_bridges.console.run_condition import RunCondition, drone_refusals
from zsim_bridges.console.run_forms import ORDERS, OrderButton, offered, refusal_lines, set_refusals
from zsim_bridges.console.run_monitor import FlightFigures

MANY = 12  # drones; of more, which do not fit on a page, the worst come first by default
FILTER_MAX = 80  # characters
SEVERITIES = ("red", "amber", None)
SORTINGS: dict[str, Callable[[DroneRow], tuple[float, ...]]] = {
    "as in the scenario": lambda _: (),
    "worst first": lambda row: (SEVERITIES.index(row.severity), row.drone.battery_percent, -row.link_badness),
    "battery, lowest first": lambda row: (row.drone.battery_percent,),
    "link, worst first": lambda row: (-row.link_badness,),
    "σ, largest first": lambda row: (-math.inf if row.drone.sigma_m is None else -row.drone.sigma_m,),
}
"""Sort keys of rows; equal ones stay in the scenario's order."""
ALL = "all"
FILTERS: dict[str, Callable[[DroneRow, "frozenset[str]"], bool]] = {
    ALL: lambda row, selected: True,
    "with an alarm": lambda row, selected: row.severity is not None,
    "in the air": lambda row, selected: row.drone.state not in DOWN,
    "on the ground": lambda row, selected: row.drone.state in DOWN,
    "battery low": lambda row, selected: row.drone.battery_percent < BATTERY_LOW_PERCENT,
    "selected": lambda row, selected: row.name in selected,
}
NO_ROW = "no drone is like that; change the filter"
DRONE_MODES = {
    "takeoff": "Take off",
    "land": "Land",
    "return": "Return",
    "emergency": "Emergency",
    "reset": "Reset",
}  # and, which is no mode, the return to the start
IN_CONTROL = ("takeoff", "return", "reset")  # these need control; any page may land a drone, or stop it
DRONE_ICONS = {"takeoff": viser.Icon.PLANE_DEPARTURE, "return": viser.Icon.HOME, "reset": viser.Icon.REFRESH}


class DroneForm:
    """Modes of one drone, or of all that are selected, on one page.

    Args:
        may: returns why this page may not let a drone take off or reset it; with true, it takes control to do so.
        request_return: lets drones return to their starts, and land.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        client: CommandClient,
        names: Sequence[str],
        may: Callable[[str, bool], str] = lambda *_: "",
        request_return: Callable[[Sequence[str]], None] = lambda _: None,
    ) -> None:
        self._client = client
        self._may = may
        self._request_return = request_return
        self._choice = gui.add_dropdown("drone", list(names))
        self._selected: list[str] = []
        self._buttons: dict[str, Any] = {}
        for mode, label in DRONE_MODES.items():
            if mode in ORDERS:
                held = mode == "emergency"
                self._buttons[mode] = OrderButton(gui, f"{label} {self._subject}", mode, self._order, held=held)
                continue
            button = gui.add_button(f"{label} {self._subject}", icon=DRONE_ICONS[mode], color="gray")
            button.on_click(lambda _, mode=mode: self._request(mode))
            self._buttons[mode] = button
        self._reasons = gui.add_html("")
        self._run = RunCondition()
        self._choice.on_update(lambda _: self._rename())

    @property
    def chosen(self) -> str:
        """Name of the chosen drone."""
        return self._choice.value

    @property
    def targets(self) -> list[str]:
        """Names of the drones that buttons are for: the selected ones, or else the chosen one."""
        return self._selected or [self.chosen]

    @property
    def _order(self) -> dict[str, str]:
        return {"drone": ",".join(self.targets)}

    @property
    def _subject(self) -> str:
        return self.targets[0] if len(self.targets) == 1 else f"{len(self.targets)} drones"

    def choose(self, drone: str) -> None:
        """Choose a drone, as a click on it in the scene does."""
        self._choice.value = drone

    def select(self, drones: Sequence[str]) -> None:
        """Let the buttons be for these drones; if there are none, for the chosen one."""
        self._selected = list(drones)
        self._rename()

    def refresh(self, run: RunCondition) -> None:
        """Grey out what all of the drones would refuse."""
        self._run = run
        refusals = [offered(run, partial(drone_refusals, drone=drone)) for drone in self.targets]
        for drone, each in zip(self.targets, refusals, strict=True):
            for mode in IN_CONTROL:
                each[mode] = each[mode] or self._may(drone, False)
        common = {mode: refusals[0][mode] if all(each[mode] for each in refusals) else "" for mode in DRONE_MODES}
        set_refusals(self._buttons, common)
        landed = {d: run.checks.get(d, ()) for d in self.targets if run.drones.get(d) == "landed"}
        checks = {drone: found for drone, found in landed.items() if found}
        shown = preflight_lines(checks) if checks and not run.grounded() else ""
        self._reasons.content = refusal_lines(DRONE_MODES, common) + shown

    def _request(self, mode: str) -> None:
        """Request what needs control, of all drones that would not refuse it."""
        able = [drone for drone in self.targets if not drone_refusals(self._run, drone)[mode]]
        drones = able or self.targets  # the condition may have changed meanwhile; otherwise the refusal is shown
        drones = [drone for drone in drones if not self._may(drone, True)]
        if not drones:
            return
        if mode == "return":
            self._request_return(drones)
        else:
            self._client.send_mode(drones, mode)

    def _rename(self) -> None:
        for mode, button in self._buttons.items():
            label = f"{DRONE_MODES[mode]} {self._subject}"
            if isinstance(button, OrderButton):
                button.name(label, self._order)
            else:
                button.label = label
        self.refresh(self._run)


class Filtered(NamedTuple):
    """How rows are sorted, one of `SORTINGS`, and which are shown, one of `FILTERS`.

    Each word of the text must be in a row's name, state, commander, faults or link.
    """

    order: str = next(iter(SORTINGS))
    choice: str = ALL
    text: str = ""

    def rows(self, rows: Sequence[DroneRow], selected: frozenset[str] = frozenset()) -> list[DroneRow]:
        """Return the rows that are shown, sorted."""
        words = self.text[:FILTER_MAX].lower().split()

        def has_words(row: DroneRow) -> bool:
            texts = (
                row.name,
                row.drone.state.replace("_", " "),
                row.drone.commander or "nobody",
                *row.faults,
                row.link[0],
            )
            return all(any(word in text.lower() for text in texts) for word in words)

        shown = [row for row in rows if FILTERS[self.choice](row, selected) and has_words(row)]
        return sorted(shown, key=SORTINGS[self.order])


class FleetTable:
    """The table of one page; `changed` is called when the selection changes."""

    def __init__(self, gui: viser.GuiApi, names: Sequence[str], changed: Callable[[], None]) -> None:
        self._names = tuple(names)
        self._changed = changed
        self._selected: frozenset[str] = frozenset()
        self._shown: tuple[str, ...] = self._names
        orders, are_many = list(SORTINGS), len(names) > MANY
        with gui.add_folder("Sort, filter, select", expand_by_default=are_many):
            self._order = gui.add_dropdown("sort by", orders, initial_value=orders[are_many])
            self._choice = gui.add_dropdown("show", list(FILTERS))
            self._text = gui.add_text("filter", "", hint="Parts of a name, state, commander, fault or link")
            select = gui.add_button_group("select", ["all shown", "none"])

        def select_shown() -> None:
            self._select(self._selected | set(self._shown) if select.value == "all shown" else frozenset())

        select.on_click(lambda _: select_shown())
        self.table = gui.add_html("")

    @property
    def selected(self) -> list[str]:
        """Names of the selected drones, in the scenario's order."""
        return [name for name in self._names if name in self._selected]

    def toggle(self, drone: str) -> None:
        """Select a drone in addition, or unselect it."""
        if drone in self._names:
            self._select(self._selected ^ {drone})

    def show(self, rows: Sequence[DroneRow], figures: Mapping[str, FlightFigures], chosen: str) -> None:
        """Show rows; `chosen` is the drone whose instruments the page shows."""
        filtered = Filtered(self._order.value, self._choice.value, self._text.value)
        shown = filtered.rows(rows, self._selected)
        self._shown = tuple(row.name for row in shown)
        self.table.content = drone_table(shown, figures, self._selected, chosen, NO_ROW if rows else "")

    def _select(self, names: frozenset[str]) -> None:
        self._selected = names
        self._changed()
