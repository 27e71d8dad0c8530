"""The controls that each page has for itself: the drone that it has chosen, and its theme."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from html import escape
from itertools import zip_longest
from typing import Any, NamedTuple

import viser

from zsim_bridges.console.command_client import CommandClient
from zsim_bridges.console.console_tables import DroneRow, event_table
from zsim_bridges.console.monitoring import event_log
from zsim_bridges.console.monitoring.event_log import EventRow
from zsim_bridges.console.monitoring.flight_figures import FlightFigures
from zsim_bridges.console.monitoring.run_condition import RunCondition
from zsim_bridges.console.page.control_desk import RUN, ControlDesk, Holding, words
from zsim_bridges.console.page.fleet_table import FleetTable
from zsim_bridges.console.page.run_forms import DroneForm
from zsim_bridges.console.scene.chosen_ring import ChosenRing
from zsim_bridges.console.scene.ground_grid import draw_ground
from zsim_bridges.console.scene.picture import Array, DronePoses

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
        self._drone = gui.add_dropdown("about", [event_log.ALL, *names])
        self._kind = gui.add_dropdown("events", list(event_log.KINDS))
        self.table = gui.add_html("")

    def show(self, rows: Sequence[EventRow]) -> None:
        """Show those of the rows, newest first, that are chosen."""
        chosen = event_log.chosen_rows(rows, self._drone.value, self._kind.value)
        self.table.content = event_table(chosen[:ROWS_SHOWN])


def _set_page_theme(page: viser.ClientHandle, *, dark: bool) -> None:
    """Set the theme of one page, with the ground of its scene."""
    set_theme(page.gui, dark=dark)
    draw_ground(page.scene, dark=dark)


def set_theme(gui: viser.GuiApi, *, dark: bool = False) -> None:
    """Set the theme of all pages, or of one."""
    gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False, dark_mode=dark)
