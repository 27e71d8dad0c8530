"""The page's panels: plots, forms and tables of one run."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import viser

from zsim.contract.messages import DroneInfo
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.command_client import CommandClient, RequestOutcome
from zsim_bridges.console.monitoring.run_condition import RunCondition
from zsim_bridges.console.page.control_desk import EVERY, RUN
from zsim_bridges.console.page.formation_form import FormationForm
from zsim_bridges.console.page.operator_input import slider_ranges
from zsim_bridges.console.page.page_forms import set_theme
from zsim_bridges.console.page.run_forms import FaultForm, FleetForm, RunForm
from zsim_bridges.console.page.variable_plots import VariablePlots, flight_history
from zsim_bridges.console.scene.flight_preview import FlightPreview
from zsim_bridges.console.scene.picture import TRAIL_S, TRAILS_S

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
