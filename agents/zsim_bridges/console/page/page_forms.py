"""The controls that each page has for itself: the drone that it has chosen, and its theme."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import viser

from zsim_bridges.console.command_client import CommandClient
from zsim_bridges.console.console_tables import DroneRow, event_table
from zsim_bridges.console.monitoring import event_log
from zsim_bridges.console.monitoring.event_log import EventRow
from zsim_bridges.console.monitoring.flight_figures import FlightFigures
from zsim_bridges.console.monitoring.run_condition import RunCondition
from zsim_bridges.console.page.fleet_table import FleetTable
from zsim_bridges.console.page.run_forms import DroneForm
from zsim_bridges.console.scene.chosen_ring import ChosenRing
from zsim_bridges.console.scene.ground_grid import draw_ground
from zsim_bridges.console.scene.picture import Array, DronePoses

ROWS_SHOWN = 60  # events


class _PageForm(NamedTuple):
    """Controls of one page."""

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
        drone_folder, figure_folder, event_folder, theme_folder: where they are to be.
        request_return: lets drones fly back to where they started.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        client: CommandClient,
        names: list[str],
        radii_m: Array,
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
        self._folders = drone_folder, figure_folder, event_folder, theme_folder
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

    def refresh(self, run: RunCondition) -> None:
        """Offer what would not be refused."""
        self._update(lambda form: form.drone.refresh(run))

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
        drone_folder, figure_folder, event_folder, theme_folder = self._folders
        with drone_folder:
            drone = DroneForm(page.gui, self._client, self._names, self._request_return)
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
            drone, fleet, ChosenRing(page.scene, self._radii_m), instruments, figures, events
        )
        if page.client_id not in self._server.get_clients():
            self._remove(page)  # it has disconnected meanwhile

    def _remove(self, page: viser.ClientHandle) -> None:
        self._forms.pop(page.client_id, None)


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
