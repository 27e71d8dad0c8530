"""The page's panels: plots, forms and tables of one run."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from html import escape
from itertools import zip_longest
from typing import Any, NamedTuple

import viser

from zsim.contract.messages import DroneInfo
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console import view_buffer
from zsim_bridges.console.command_client import CommandClient, RequestOutcome
from zsim_bridges.console.console_tables import DroneRow, event_table
from zsim_bridges.console.control_desk import EVERY, RUN, ControlDesk, Holding, words
from zsim_bridges.console.drone_forms import FleetTable
from zsim_bridges.console.formation_form import FormationForm
from zsim_bridges.console.histories import TRAIL_S, TRAILS_S
from zsim_bridges.console.operator_input import slider_ranges
from zsim_bridges.console.picture import Array, DronePoses, FlightPreview
from zsim_bridges.console.run_condition import RunCondition
from zsim_bridges.console.run_forms import DroneForm, FaultForm, FleetForm, RunForm
from zsim_bridges.console.run_monitor import FlightFigures
from zsim_bridges.console.scene_nodes import ChosenRing, draw_ground
from zsim_bridges.console.variable_plots import VariablePlots, flight_history
from zsim_bridges.console.view_buffer import EventRow

ROWS_SHOWN = 60  # events
SILENT_SHOWN_S = 3.0  # wall; pages look twice a second


class _PageForm(NamedTuple):
    """Controls of one page."""

    control: "ControlForm"
    drone: DroneForm
    fleet: FleetTable
    ring: ChosenRing
    instruments: viser.GuiHtmlHandle
    figures: viser.GuiHtmlHandle
    events: "EventForm"


class PageForms:
    """Adds controls to each page of a run, and keeps them.

    Args:
        server: viser's.
        client: sends requests.
        names, radii_m: of the drones.
        desk: which page is in control.
        part_of: returns what a page must be in control of to let a drone take off.
        controls: what it must be in control of to use a control of all pages, by the control's id.
        control_folder, drone_folder, figure_folder, event_folder, theme_folder: where they are to be.
        request_return: lets drones fly back to where they started.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        client: CommandClient,
        names: list[str],
        radii_m: Array,
        desk: ControlDesk,
        part_of: Callable[[str], str],
        controls: Mapping[str, str],
        control_folder: Any,
        drone_folder: Any,
        figure_folder: Any,
        event_folder: Any,
        theme_folder: Any,
        request_return: Callable[[Sequence[str]], None] = lambda _: None,
    ) -> None:
        self._request_return = request_return
        self._server = server
        self._client = client
        self._names = names
        self._radii_m = radii_m
        self._desk = desk
        self._part_of = part_of
        self._controls = controls
        self._folders = control_folder, drone_folder, figure_folder, event_folder, theme_folder
        self._forms: dict[int, _PageForm] = {}
        self._closed = False
        server.on_client_connect(self._add)
        server.on_client_disconnect(self._remove)

    def close(self) -> None:
        """Add nothing to later pages."""
        self._closed = True

    def choose(self, client_id: int | None, drone: str) -> None:
        """Choose a drone on one page, as a click on it in the scene does."""
        form = self._forms.get(-1 if client_id is None else client_id)
        if form is not None:
            form.drone.choose(drone)

    def toggle(self, client_id: int | None, drone: str) -> None:
        """Select a drone on one page for one command with others, or no longer."""
        form = self._forms.get(-1 if client_id is None else client_id)
        if form is not None:
            form.fleet.toggle(drone)

    def chosen(self, client_id: int | None) -> str:
        """Return the drone that one page has chosen; empty of one that is not open."""
        form = self._forms.get(-1 if client_id is None else client_id)
        return form.drone.chosen if form is not None else ""

    def use(self, client_id: int, drone: str) -> str:
        """Put a page in control of a drone's formation where that is free; return why it may not be."""
        return self._may(client_id, drone, use=True)

    def move_rings(self, drones: DronePoses) -> None:
        """Put the ring of each page about the drone that it has chosen."""
        self._update(lambda form: form.ring.move(drones, form.drone.chosen))

    def show_figures(self, instruments_of: Callable[[str], str], sensors_of: Callable[[str], str]) -> None:
        """Show on each page instruments and sensors of the drone that it has chosen; both of a drone are HTML."""
        chosen = {form.drone.chosen for form in list(self._forms.values())}
        contents = {drone: (instruments_of(drone), sensors_of(drone)) for drone in chosen}

        def show(form: _PageForm) -> None:
            form.instruments.content, form.figures.content = contents.get(form.drone.chosen, ("", ""))

        self._update(show)

    def show_drones(self, rows: Sequence[DroneRow], figures: Mapping[str, FlightFigures]) -> None:
        """Show on each page the drones as it sorts and filters them."""
        self._update(lambda form: form.fleet.show(rows, figures, form.drone.chosen))

    def show_events(self, rows: Sequence[EventRow]) -> None:
        """Show on each page the events that it has chosen."""
        self._update(lambda form: form.events.show(rows))

    def refresh(self, run: RunCondition, formation: str) -> None:
        """Offer what would not be refused; show who is in control of the formation that is shown, and of the run."""
        self._update(lambda form: form.drone.refresh(run))
        self._update(lambda form: form.control.refresh([formation, RUN] if formation else [RUN]))

    def _update(self, change: Callable[[_PageForm], None]) -> None:
        """Change the forms of all pages but of those that are closed just then, whose handles viser has removed."""
        for client_id, form in list(self._forms.items()):
            try:
                change(form)
            except RuntimeError:
                self._forms.pop(client_id, None)

    def _add(self, page: viser.ClientHandle) -> None:
        if self._closed:
            return
        control_folder, drone_folder, figure_folder, event_folder, theme_folder = self._folders
        self._desk.open(page.client_id)
        with control_folder:
            control = ControlForm(page.gui, self._desk, page.client_id, self._controls)
        with drone_folder:
            may = partial(self._may, page.client_id)
            drone = DroneForm(page.gui, self._client, self._names, may, self._request_return)
            instruments = page.gui.add_html("")
            fleet = FleetTable(page.gui, self._names, lambda: drone.select(fleet.selected))
        with figure_folder:
            figures = page.gui.add_html("")
        with event_folder:
            events = EventForm(page.gui, self._names)
        with theme_folder:
            theme = page.gui.add_checkbox("Dark theme", False)
        theme.on_update(lambda _: _set_page_theme(page, dark=theme.value))
        self._forms[page.client_id] = _PageForm(
            control, drone, fleet, ChosenRing(page.scene, self._radii_m), instruments, figures, events
        )
        if page.client_id not in self._server.get_clients():
            self._remove(page)  # it has disconnected meanwhile

    def _remove(self, page: viser.ClientHandle) -> None:
        self._forms.pop(page.client_id, None)
        self._desk.close(page.client_id)

    def _may(self, client_id: int, drone: str, use: bool) -> str:
        """Return why a page may not let a drone take off; `use` puts it in control where it may."""
        part = self._part_of(drone)
        return self._desk.use(client_id, part) if use else self._desk.refusal(client_id, part)


CONTROL_STYLE = "font-size:12px;line-height:1.35;padding:2px 10px 6px;overflow-wrap:anywhere"


class ControlForm:
    """Who is in control, on one page: asks for it, grants it, gives it up.

    Args:
        gui: viser's of that page, in the folder where it is to be.
        desk: which page is in control.
        page: viser's number of this one.
        part_of: part of each control of all pages, by its id; viser gives the element on the page the same.
    """

    def __init__(self, gui: viser.GuiApi, desk: ControlDesk, page: int, part_of: Mapping[str, str]) -> None:
        self._part_of = part_of
        self._desk = desk
        self._page = page
        self._parts: list[str] = []
        self._text = gui.add_html("")
        self._buttons: list[tuple[Any, Any]] = []
        for place in range(2):  # the formation that is shown, and the run
            first, second = gui.add_button("Ask", visible=False), gui.add_button("Keep", visible=False, color="gray")
            first.on_click(lambda _, place=place: self._press(place))
            second.on_click(lambda _, place=place: self._answer(place, granted=False))
            self._buttons.append((first, second))

    def refresh(self, parts: list[str]) -> None:
        """Show who is in control of some parts."""
        self._parts = parts
        holdings, others = self._desk.holdings(self._page, parts), self._desk.others(self._page)
        here = f"you are {escape(self._desk.name_of(self._page))}"
        lines = [f"<b>Control</b>: {here}, alone here"]
        if others:
            lines = [f"<b>Control</b>: {here}; also here: {escape(', '.join(others))}", *map(_holding_line, holdings)]
        content = f"<div style='{CONTROL_STYLE}'>{'<br>'.join(lines)}</div>{self._greyed()}"
        if self._text.content != content:
            self._text.content = content
        for (first, second), holding in zip_longest(self._buttons, holdings):
            label, asked = _offer(holding) if others else ("", False)
            _show_button(first, label)
            _show_button(second, f"Keep {words(holding.part)}" if holding and asked else "")

    def _greyed(self) -> str:
        """Return the style that greys out, on this page, the controls of what others are in control of."""
        held = self._desk.held_by_others(self._page)
        rules = ",".join(f'[id="{control}"]' for control, part in self._part_of.items() if part in held)
        return f"<style>{rules}{{opacity:.35}}</style>" if rules else ""

    def _press(self, place: int) -> None:
        for holding in self._desk.holdings(self._page, self._parts[place : place + 1]):
            if not holding.mine:
                self._desk.ask(self._page, holding.part)
            elif holding.asker:
                self._answer(place, granted=True)
            else:
                self._desk.release(self._page, holding.part)
        self.refresh(self._parts)

    def _answer(self, place: int, granted: bool) -> None:
        for part in self._parts[place : place + 1]:
            self._desk.answer(self._page, part, granted)
        self.refresh(self._parts)


def _holding_line(holding: Holding) -> str:
    name = escape(words(holding.part))
    if not holding.holder:
        return f"{name}: free"
    silent = f", silent for {holding.silent_s:.0f} s" if holding.silent_s > SILENT_SHOWN_S else ""
    who = "<b>you</b>" if holding.mine else f"<b>{escape(holding.holder)}</b>{silent}"
    asked = ""
    if holding.asked_by_me:
        asked = "; you have asked for it"
    elif holding.asker:
        asked = f"; <b>{escape(holding.asker)} asks for it</b>"
    return f"{name}: {who}{asked}"


def _offer(holding: Holding | None) -> tuple[str, bool]:
    """Return the label of the first button of a part, empty for none, and whether somebody asks this page for it."""
    if holding is None or not holding.holder or holding.asked_by_me:
        return "", False
    if not holding.mine:
        return f"Ask for {words(holding.part)}", False
    if holding.asker:
        return f"Give {words(holding.part)} to {holding.asker}", True
    return f"Release {words(holding.part)}", False


def _show_button(button: Any, label: str) -> None:
    if label and button.label != label:
        button.label = label
    if button.visible != bool(label):
        button.visible = bool(label)


class EventForm:
    """The events that one page has chosen, by drone and kind.

    Args:
        gui: viser's of that page, in the folder where they are to be.
        names: of the drones.
    """

    def __init__(self, gui: viser.GuiApi, names: list[str]) -> None:
        self._drone = gui.add_dropdown("about", [view_buffer.ALL, *names])
        self._kind = gui.add_dropdown("events", list(view_buffer.KINDS))
        self.table = gui.add_html("")

    def show(self, rows: Sequence[EventRow]) -> None:
        """Show those of the rows, newest first, that are chosen."""
        chosen = view_buffer.chosen_rows(rows, self._drone.value, self._kind.value)
        self.table.content = event_table(chosen[:ROWS_SHOWN])


def _set_page_theme(page: viser.ClientHandle, *, dark: bool) -> None:
    """Set the theme of one page, with the ground of its scene."""
    set_theme(page.gui, dark=dark)
    draw_ground(page.scene, dark=dark)


def set_theme(gui: viser.GuiApi, *, dark: bool = False) -> None:
    """Set the theme of all pages, or of one."""
    gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False, dark_mode=dark)


PANEL_PX = 350
SWITCHES = {
    "ghosts": "Ghosts: where the formation is to be",
    "estimates": "Estimates: 2σ ellipsoids (hold 74 % in 3-D)",
    "trails": "Trails",
}


class ConsolePage:
    """The controls of one run, in two panels.

    Args:
        gui: viser's; what another run has left on it is removed.
        scenario: names what there is.
        spaces: of its formations.
        client: sends requests.
        report: called with requests that are refused without being sent.
        show: shows or hides one of `SWITCHES` in the scene.
        rate: that the run was started with.
        drones: of the run, with their rotors.
        choose_trail: lets trails go back so far [s].
        replayed: whether a record is played back.
        request_return: lets a formation fly back to where it started, and land.
        show_preview: shows what a formation would fly, None for nothing.

    Attributes:
        phases, faults: the tables.
        forms, plots: of each formation.
        flights: what plots show of single drones.
        chosen: the formation that is shown; empty where there is none.
        fleet: requests of all drones.
        control_folder, drone_folder, figure_folder, event_folder, theme_folder: of what each page has for itself.
        parts: what a page must be in control of to use a control, by the control's id.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        scenario: Scenario,
        spaces: Mapping[str, ClusterSpace],
        client: CommandClient,
        report: Callable[[RequestOutcome], None],
        show: Callable[[str, bool], None],
        rate: float,
        drones: Sequence[DroneInfo] = (),
        choose_trail: Callable[[float], None] = lambda _: None,
        replayed: bool = False,
        request_return: Callable[[str], None] = lambda _: None,
        show_preview: Callable[[str, FlightPreview | None], None] = lambda name, preview: None,
    ) -> None:
        self._show_preview = show_preview
        self._request_return = request_return
        self._choose_trail = choose_trail
        self._replayed = replayed
        self._scenario = scenario
        self._spaces = spaces
        self._client = client
        self._report = report
        self._show = show
        self._rate = rate
        self._drones = drones
        self.forms: dict[str, FormationForm] = {}
        self.plots: dict[str, VariablePlots] = {}
        self.flights = flight_history([drone.name for drone in scenario.drones], around=replayed)
        self.chosen = next(iter(spaces), "")
        self.parts: dict[str, str] = {}
        self._folders: dict[str, list[viser.GuiFolderHandle]] = {}
        self._set_theme(gui)
        self._right_panel(gui)
        self._left_panel(gui)

    def _set_theme(self, gui: viser.GuiApi) -> None:
        gui.reset()
        set_theme(gui)
        gui.set_panel_label(f"zsim {self._scenario.name}")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)

    def _right_panel(self, gui: viser.GuiApi) -> None:
        self.phases = gui.add_html("")
        self.control_folder = gui.add_folder(None)
        with self._part(gui, EVERY):
            self.fleet = FleetForm(gui, self._client, self._scenario)
        if len(self._spaces) > 1:
            choice = gui.add_dropdown("formation", list(self._spaces))
            choice.on_update(lambda _: self._show_formation(choice.value))
        tabs = gui.add_tab_group()
        if self._spaces:
            self._formation_tabs(gui, tabs)
        with tabs.add_tab("Faults"):
            self.faults = gui.add_html("")
            with self._part(gui, RUN):
                FaultForm(gui, self._client, self._report, self._scenario, self._drones)
        with tabs.add_tab("Run"):
            with self._part(gui, RUN):
                self.run_form = RunForm(gui, self._client, self._rate)
            self._switches(gui)
            self.theme_folder = gui.add_folder(None)

    def _formation_tabs(self, gui: viser.GuiApi, tabs: Any) -> None:
        """Give every formation a folder in two tabs; only that of the chosen one is visible."""
        fly, plots = tabs.add_tab("Fly"), tabs.add_tab("Plots")
        for cluster in self._scenario.clusters:
            name, space = cluster.name, self._spaces[cluster.name]
            limits = slider_ranges(space, cluster, self._scenario)
            with fly, gui.add_folder(None, visible=name == self.chosen) as form_folder, self._part(gui, name):
                form = FormationForm(
                    gui,
                    self._client,
                    self._report,
                    cluster,
                    space,
                    limits,
                    self._request_return,
                    partial(self._show_preview, name),
                )
            self.forms[name] = form
            for control in form.safe:
                self.parts.pop(control._impl.uuid if hasattr(control, "_impl") else "", None)
            with plots, gui.add_folder(None, visible=name == self.chosen) as plot_folder:
                self.plots[name] = VariablePlots(gui, cluster, limits, self.flights, self._replayed)
            self._folders[name] = [form_folder, plot_folder]

    @contextmanager
    def _part(self, gui: viser.GuiApi, part: str) -> Iterator[None]:
        """Note that the controls that are added meanwhile belong to a part; viser has no public way to their ids."""
        before = set(_control_ids(gui))
        yield
        self.parts |= dict.fromkeys(set(_control_ids(gui)) - before, part)

    def _show_formation(self, chosen: str) -> None:
        self.chosen = chosen
        for name, folders in self._folders.items():
            for folder in folders:
                folder.visible = name == chosen

    def refresh(self, run: RunCondition) -> None:
        """Grey out what would be refused."""
        self.fleet.refresh(run)
        self.run_form.refresh(run)
        for form in self.forms.values():
            form.offer(run)

    def _switches(self, gui: viser.GuiApi) -> None:
        for what, label in SWITCHES.items():
            switch = gui.add_checkbox(label, True)
            switch.on_update(lambda _, what=what, switch=switch: self._show(what, switch.value))
        lengths = {f"the last {length_s:g} s": length_s for length_s in TRAILS_S}
        chosen = next(text for text, length_s in lengths.items() if length_s == TRAIL_S)
        trail = gui.add_dropdown("trails of", list(lengths), initial_value=chosen)
        trail.on_update(lambda _: self._choose_trail(lengths[trail.value]))

    def _left_panel(self, gui: viser.GuiApi) -> None:
        panel = gui.add_panel()
        with panel.add_tab("Drones", viser.Icon.DRONE):
            self.drone_folder = gui.add_folder(None)
            self.figure_folder = gui.add_folder(None)
        with panel.add_tab("Events", viser.Icon.LIST):
            self.event_folder = gui.add_folder(None)
        panel.dock_left()
        panel.set_width(PANEL_PX)


def _control_ids(gui: viser.GuiApi) -> Collection[str]:
    return getattr(gui, "_gui_input_handle_from_uuid", ())
