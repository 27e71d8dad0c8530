"""The panels of the page during one run: forms, plots and tables that all pages share, and those of each page.

Each page has its own mode buttons for the chosen drone (or for drones selected for one command), its own table of
drones, and its own list of events.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import viser

from zsim_agents.formation.flight_check import DOWN
from zsim_bridges.console.console_tables import DroneRow, drone_table, event_table, metric_lines, preflight_lines
from zsim_bridges.console.control_desk import ALL_PARTS, RUN, ControlDesk, ControlForm
from zsim_bridges.console.formation_form import FormationForm
from zsim_bridges.console.histories import TRAIL_S, TRAILS_S, FlightHistory, VariablePlots
from zsim_bridges.console.orders import CommandClient, RequestOutcome
from zsim_bridges.console.page_server import control_id, control_ids
from zsim_bridges.console.picture import Array, DronePoses, FlightPreview
from zsim_bridges.console.run_condition import BATTERY_LOW_PERCENT, RunCondition, ShownRun, drone_refusals
from zsim_bridges.console.run_forms import (
    ORDERS,
    FaultForm,
    FleetForm,
    OrderButton,
    RunForm,
    offered_refusals,
    refusal_lines,
    set_refusals,
)
from zsim_bridges.console.run_monitor import FlightMetrics
from zsim_bridges.console.scene import ChosenRing, draw_ground
from zsim_bridges.console.view_buffer import ALL, KINDS, EventRow, chosen_rows

PANEL_PX = 350
ROWS_SHOWN = 60  # maximum number of events shown
SWITCHES = {
    "ghosts": "Ghosts: the desired formation",
    "estimates": "Estimates: 2σ ellipsoids (contain 74 % in 3-D)",
    "trails": "Trails",
}
MANY_DRONES = 12  # number of drones that fit on a page; if there are more, the worst come first by default
FILTER_MAX = 80  # maximum length of the filter's text
SEVERITIES = ("red", "amber", None)
SORTINGS: dict[str, Callable[[DroneRow], tuple[float, ...]]] = {
    "as in the scenario": lambda _: (),
    "worst first": lambda row: (SEVERITIES.index(row.severity), row.drone.battery_percent, -row.link_badness),
    "battery, lowest first": lambda row: (row.drone.battery_percent,),
    "link, worst first": lambda row: (-row.link_badness,),
    "σ, largest first": lambda row: (-math.inf if row.drone.sigma_m is None else -row.drone.sigma_m,),
}
"""Sort keys of rows; rows with equal keys stay in the scenario's order."""
FILTERS: dict[str, Callable[[DroneRow, "frozenset[str]"], bool]] = {
    ALL: lambda row, selected: True,
    "with an alarm": lambda row, selected: row.severity is not None,
    "in the air": lambda row, selected: row.drone.state not in DOWN,
    "on the ground": lambda row, selected: row.drone.state in DOWN,
    "battery low": lambda row, selected: row.drone.battery_percent < BATTERY_LOW_PERCENT,
    "selected": lambda row, selected: row.name in selected,
}
NO_ROW = "no drone matches; change the filter"
DRONE_MODES = {
    "takeoff": "Take off",
    "land": "Land",
    "return": "Return",
    "emergency": "Emergency",
    "reset": "Reset",
}  # `return`, to the start, is not a mode of the firmware
MODES_NEEDING_CONTROL = ("takeoff", "return", "reset")  # any operator's page may land or stop a drone
DRONE_ICONS = {"takeoff": viser.Icon.PLANE_DEPARTURE, "return": viser.Icon.HOME, "reset": viser.Icon.REFRESH}


class ConsolePage:
    """The controls of one run that all pages share, in two panels; the folders are for each page's own controls.

    Args:
        gui: viser's controls; those of another run are removed.
        report: called with the outcome of each request that is refused without being sent.
        show: shows or hides one of `SWITCHES` in the scene.
        choose_trail: sets the length of trails [s].
        request_return: returns a formation to its start, and lands it.
        show_preview: shows the path that a formation would fly; None: removes it.

    Attributes:
        flights: history of single drones, for plots.
        chosen: name of the shown formation; empty if there is none.
        parts: the part of the run that a page must be in control of to use a control, by the control's id.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        run: ShownRun,
        client: CommandClient,
        report: Callable[[RequestOutcome], None],
        show: Callable[[str, bool], None],
        choose_trail: Callable[[float], None] = lambda _: None,
        request_return: Callable[[str], None] = lambda _: None,
        show_preview: Callable[[str, FlightPreview | None], None] = lambda name, preview: None,
    ) -> None:
        self._run = run
        self._client = client
        self._report = report
        self._request_return = request_return
        self._show_preview = show_preview
        self.forms: dict[str, FormationForm] = {}
        self.plots: dict[str, VariablePlots] = {}
        self.flights = FlightHistory([drone.name for drone in run.scenario.drones], is_replay=run.is_replay)
        self.chosen = next(iter(run.spaces), "")
        self.parts: dict[str, str] = {}
        self._folders: dict[str, list[viser.GuiFolderHandle]] = {}
        gui.reset()
        set_theme(gui)
        gui.set_panel_label(f"zsim {run.scenario.name}")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        self.phases = gui.add_html("")
        self.control_folder = gui.add_folder(None)
        with self._assign(gui, ALL_PARTS):
            self.fleet = FleetForm(gui, self._client, run.scenario)
        if len(run.spaces) > 1:
            choice = gui.add_dropdown("formation", list(run.spaces))
            choice.on_update(lambda _: self._show_formation(choice.value))
        tabs = gui.add_tab_group()
        if run.spaces:
            self._formation_tabs(gui, tabs)
        with tabs.add_tab("Faults"):
            self.faults = gui.add_html("")
            with self._assign(gui, RUN):
                FaultForm(gui, self._client, self._report, run.scenario, run.info.drones)
        with tabs.add_tab("Run"):
            with self._assign(gui, RUN):
                self.run_form = RunForm(gui, self._client, run.info.rate)
            for layer, label in SWITCHES.items():
                switch = gui.add_checkbox(label, True)
                switch.on_update(lambda _, layer=layer, switch=switch: show(layer, switch.value))
            lengths = {f"the last {length_s:g} s": length_s for length_s in TRAILS_S}
            trail = gui.add_dropdown("trails of", list(lengths), initial_value=f"the last {TRAIL_S:g} s")
            trail.on_update(lambda _: choose_trail(lengths[trail.value]))
            self.theme_folder = gui.add_folder(None)
        panel = gui.add_panel()
        with panel.add_tab("Drones", viser.Icon.DRONE):
            self.drone_folder = gui.add_folder(None)
            self.instrument_folder = gui.add_folder(None)
        with panel.add_tab("Events", viser.Icon.LIST):
            self.event_folder = gui.add_folder(None)
        panel.dock_left()
        panel.set_width(PANEL_PX)

    def _formation_tabs(self, gui: viser.GuiApi, tabs: Any) -> None:
        """Add a folder for each formation to two tabs; only the chosen formation's folders are visible."""
        fly, plots = tabs.add_tab("Fly"), tabs.add_tab("Plots")
        for cluster in self._run.scenario.clusters:
            name, space = cluster.name, self._run.spaces[cluster.name]
            preview = partial(self._show_preview, name)
            with fly, gui.add_folder(None, visible=name == self.chosen) as form_folder, self._assign(gui, name):
                form = FormationForm(
                    gui, self._client, self._report, cluster, space, self._run.scenario, self._request_return, preview
                )
            self.forms[name] = form
            for control in form.safe:
                self.parts.pop(control_id(control), None)
            with plots, gui.add_folder(None, visible=name == self.chosen) as plot_folder:
                self.plots[name] = VariablePlots(gui, cluster, space.names, self.flights, self._run.is_replay)
            self._folders[name] = [form_folder, plot_folder]

    @contextmanager
    def _assign(self, gui: viser.GuiApi, part: str) -> Iterator[None]:
        """Assign the controls added in this context to a part of the run."""
        previous_ids = control_ids(gui)
        yield
        self.parts |= dict.fromkeys(control_ids(gui) - previous_ids, part)

    def _show_formation(self, chosen: str) -> None:
        self.chosen = chosen
        for name, folders in self._folders.items():
            for folder in folders:
                folder.visible = name == chosen

    def refresh(self, run: RunCondition) -> None:
        self.fleet.refresh(run)
        self.run_form.refresh(run)
        for form in self.forms.values():
            form.offer(run)


class _PageForm(NamedTuple):
    """Controls of one page."""

    control: ControlForm
    drone: "DroneForm"
    fleet: "FleetTable"
    ring: ChosenRing
    instruments: viser.GuiHtmlHandle
    sensor_table: viser.GuiHtmlHandle
    events: "EventForm"


class PageForms:
    """Adds the per-page controls to each page of a run, and keeps them.

    Args:
        shared: the controls that all pages share, with folders for each page's own.
        names, radii_m: names and radii of the drones.
        part_of: returns the part of the run that a page must be in control of to let a drone take off.
        request_return: returns drones to their starts, and lands them.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        client: CommandClient,
        shared: ConsolePage,
        names: Sequence[str],
        radii_m: Array,
        desk: ControlDesk,
        part_of: Callable[[str], str],
        request_return: Callable[[Sequence[str]], None] = lambda _: None,
    ) -> None:
        self._server = server
        self._client = client
        self._shared = shared
        self._names = list(names)
        self._radii_m = radii_m
        self._desk = desk
        self._part_of = part_of
        self._request_return = request_return
        self._forms: dict[int | None, _PageForm] = {}  # by viser's number of the page
        self._closed = False
        server.on_client_connect(self._add)
        server.on_client_disconnect(self._remove)

    def close(self) -> None:
        """Add no controls to pages that are opened later."""
        self._closed = True

    def choose(self, client_id: int | None, drone: str) -> None:
        if (form := self._forms.get(client_id)) and drone in self._names:
            form.drone.choose(drone)

    def toggle(self, client_id: int | None, drone: str) -> None:
        """Select a drone on one page for a command to several drones, or deselect it."""
        if form := self._forms.get(client_id):
            form.fleet.toggle(drone)

    def chosen(self, client_id: int | None) -> str:
        """Return the drone that one page has chosen; empty for a page that is not open."""
        form = self._forms.get(client_id)
        return form.drone.chosen if form else ""

    def use(self, client_id: int | None, drone: str) -> str:
        """Let a page take control of a drone's part of the run; return why it may not, empty if it may."""
        return self._desk.use(client_id, self._part_of(drone), drone) if client_id is not None else ""

    def move_rings(self, drones: DronePoses) -> None:
        self._update(lambda form: form.ring.move(drones, form.drone.chosen))

    def show(
        self,
        rows: Sequence[DroneRow],
        metrics: Mapping[str, FlightMetrics],
        sensors_of: Callable[[Collection[str]], Mapping[str, str]],
        events: Sequence[EventRow],
    ) -> None:
        """Show on each page the sorted and filtered drones, the figures of the chosen one, and the filtered events.

        `sensors_of` returns the table of each drone's sensors as HTML, by drone.
        """
        chosen = {form.drone.chosen for form in list(self._forms.values())}
        contents = {drone: (metric_lines(metrics.get(drone)), table) for drone, table in sensors_of(chosen).items()}

        def show(form: _PageForm) -> None:
            form.instruments.content, form.sensor_table.content = contents.get(form.drone.chosen, ("", ""))
            form.events.show(events)
            form.fleet.show(rows, metrics, form.drone.chosen)

        self._update(show)

    def refresh(self, run: RunCondition, formation: str) -> None:
        """Disable controls whose requests would be refused; show who is in control of the formation and the run."""

        def refresh(form: _PageForm) -> None:
            form.drone.refresh(run)
            form.control.refresh([formation, RUN] if formation else [RUN])

        self._update(refresh)

    def _update(self, change: Callable[[_PageForm], None]) -> None:
        """Change the forms of all pages; drop a page that has closed meanwhile, whose handles viser has removed."""
        for client_id, form in list(self._forms.items()):
            try:
                change(form)
            except RuntimeError:
                self._forms.pop(client_id, None)

    def _add(self, page: viser.ClientHandle) -> None:
        if self._closed:
            return
        shared, gui, client_id = self._shared, page.gui, page.client_id
        self._desk.open(client_id)

        def control_refusal(drone: str, use: bool) -> str:
            part = self._part_of(drone)
            return self._desk.use(client_id, part, drone) if use else self._desk.refusal(client_id, part, drone)

        with shared.control_folder:
            control = ControlForm(gui, self._desk, client_id, shared.parts)
        with shared.drone_folder:
            drone = DroneForm(gui, self._client, self._names, control_refusal, self._request_return)
            instruments = gui.add_html("")
            fleet = FleetTable(gui, self._names, lambda: drone.select(fleet.selected))
        with shared.instrument_folder:
            sensor_table = gui.add_html("")
        with shared.event_folder:
            events = EventForm(gui, self._names)
        with shared.theme_folder:
            theme = gui.add_checkbox("Dark theme", False)

        def set_page_theme() -> None:
            set_theme(gui, dark=theme.value)
            draw_ground(page.scene, dark=theme.value)

        theme.on_update(lambda _: set_page_theme())
        ring = ChosenRing(page.scene, self._radii_m)
        self._forms[client_id] = _PageForm(control, drone, fleet, ring, instruments, sensor_table, events)
        if client_id not in self._server.get_clients():
            self._remove(page)  # it has disconnected meanwhile

    def _remove(self, page: viser.ClientHandle) -> None:
        self._forms.pop(page.client_id, None)
        self._desk.close(page.client_id)


class DroneForm:
    """The mode buttons on one page, for one drone or for all selected ones.

    Args:
        control_refusal: returns why this page may not let a drone take off, return or reset; empty if it may. If the
            second argument is true, the page takes control first.
        request_return: returns drones to their starts, and lands them.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        client: CommandClient,
        names: Sequence[str],
        control_refusal: Callable[[str, bool], str] = lambda *_: "",
        request_return: Callable[[Sequence[str]], None] = lambda _: None,
    ) -> None:
        self._client = client
        self._control_refusal = control_refusal
        self._request_return = request_return
        self._choice = gui.add_dropdown("drone", list(names))
        self._selected: list[str] = []
        self._buttons: dict[str, Any] = {}
        for mode, label in DRONE_MODES.items():
            if mode in ORDERS:
                needs_hold = mode == "emergency"
                self._buttons[mode] = OrderButton(
                    gui, f"{label} {self._subject}", mode, self._order_target, needs_hold=needs_hold
                )
                continue
            button = gui.add_button(f"{label} {self._subject}", icon=DRONE_ICONS[mode], color="gray")
            button.on_click(lambda _, mode=mode: self._request(mode))
            self._buttons[mode] = button
        self._reasons = gui.add_html("")
        self._run = RunCondition()
        self._choice.on_update(lambda _: self._rename())

    @property
    def chosen(self) -> str:
        return self._choice.value

    @property
    def targets(self) -> list[str]:
        """Names of the drones to which the buttons apply: the selected ones, or else the chosen one."""
        return self._selected or [self.chosen]

    @property
    def _order_target(self) -> dict[str, str]:
        return {"drone": ",".join(self.targets)}

    @property
    def _subject(self) -> str:
        return self.targets[0] if len(self.targets) == 1 else f"{len(self.targets)} drones"

    def choose(self, drone: str) -> None:
        self._choice.value = drone

    def select(self, drones: Sequence[str]) -> None:
        """Apply the buttons to these drones; if there are none, to the chosen one."""
        self._selected = list(drones)
        self._rename()

    def refresh(self, run: RunCondition) -> None:
        """Disable the buttons whose commands would be refused for all of the drones."""
        self._run = run
        refusals = [offered_refusals(run, partial(drone_refusals, drone=drone)) for drone in self.targets]
        for drone, each in zip(self.targets, refusals, strict=True):
            for mode in MODES_NEEDING_CONTROL:
                each[mode] = each[mode] or self._control_refusal(drone, False)
        common = {mode: refusals[0][mode] if all(each[mode] for each in refusals) else "" for mode in DRONE_MODES}
        set_refusals(self._buttons, common)
        landed = {d: run.checks.get(d, ()) for d in self.targets if run.drones.get(d) == "landed"}
        checks = {drone: drone_checks for drone, drone_checks in landed.items() if drone_checks}
        shown = preflight_lines(checks) if checks and not run.flight_refusal() else ""
        self._reasons.content = refusal_lines(DRONE_MODES, common) + shown

    def _request(self, mode: str) -> None:
        """Request an operation of all drones that would not refuse it, as far as the page may control them."""
        accepting = [drone for drone in self.targets if not drone_refusals(self._run, drone)[mode]]
        # If all would refuse, the answers state why, unless the condition has changed.
        drones = accepting or self.targets
        drones = [drone for drone in drones if not self._control_refusal(drone, True)]
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
                button.rename(label, self._order_target)
            else:
                button.label = label
        self.refresh(self._run)


class FleetTable:
    """The table of drones on one page; `on_change` is called when the selection changes."""

    def __init__(self, gui: viser.GuiApi, names: Sequence[str], on_change: Callable[[], None]) -> None:
        self._names = tuple(names)
        self._on_change = on_change
        self._selected: frozenset[str] = frozenset()
        self._shown: tuple[str, ...] = self._names
        orders, are_many = list(SORTINGS), len(names) > MANY_DRONES
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
        return [name for name in self._names if name in self._selected]

    def toggle(self, drone: str) -> None:
        if drone in self._names:
            self._select(self._selected ^ {drone})

    def show(self, rows: Sequence[DroneRow], metrics: Mapping[str, FlightMetrics], chosen: str) -> None:
        """Show rows; `chosen` is the drone whose instruments the page shows."""
        shown = filtered_rows(rows, self._order.value, self._choice.value, self._text.value, self._selected)
        self._shown = tuple(row.name for row in shown)
        self.table.content = drone_table(shown, metrics, self._selected, chosen, NO_ROW if rows else "")

    def _select(self, names: frozenset[str]) -> None:
        self._selected = names
        self._on_change()


def filtered_rows(
    rows: Sequence[DroneRow],
    order: str = next(iter(SORTINGS)),
    choice: str = ALL,
    text: str = "",
    selected: frozenset[str] = frozenset(),
) -> list[DroneRow]:
    """Return rows sorted by one of `SORTINGS` and filtered by one of `FILTERS`.

    Each word of `text` must occur in a row's name, state, commander, faults or link.
    """
    words = text[:FILTER_MAX].lower().split()

    def has_words(row: DroneRow) -> bool:
        drone = row.drone
        texts = row.name, drone.state.replace("_", " "), drone.commander or "nobody", *row.faults, row.link[0]
        return all(any(word in each.lower() for each in texts) for word in words)

    return sorted((row for row in rows if FILTERS[choice](row, selected) and has_words(row)), key=SORTINGS[order])


class EventForm:
    """The events that one page shows, filtered by drone and kind."""

    def __init__(self, gui: viser.GuiApi, names: Sequence[str]) -> None:
        self._drone = gui.add_dropdown("about", [ALL, *names])
        self._kind = gui.add_dropdown("events", list(KINDS))
        self._table = gui.add_html("")

    def show(self, rows: Sequence[EventRow]) -> None:
        self._table.content = event_table(chosen_rows(rows, self._drone.value, self._kind.value)[:ROWS_SHOWN])


def set_theme(gui: viser.GuiApi, *, dark: bool = False) -> None:
    gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False, dark_mode=dark)
