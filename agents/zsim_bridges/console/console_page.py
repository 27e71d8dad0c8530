"""The page's controls and tables, each in its place."""

from collections.abc import Callable, Mapping
from typing import Any

import viser

from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.command_client import CommandClient, RequestOutcome
from zsim_bridges.console.forms.fault_form import FaultForm
from zsim_bridges.console.forms.formation_form import FormationForm
from zsim_bridges.console.forms.run_form import DroneForm, FleetForm, RunForm
from zsim_bridges.console.forms.slider_limits import slider_ranges
from zsim_bridges.console.scene.plots import VariablePlots

PANEL_PX = 350
SWITCHES = {
    "ghosts": "Ghosts: where the formation is to be",
    "estimates": "Estimates: 2σ ellipsoids (hold 74 % in 3-D)",
    "trails": "Trails",
}


class ConsolePage:
    """The controls of one run, in two panels.

    Args:
        gui: viser's; whatever another run has left on it goes.
        scenario: names what there is.
        spaces: of its formations.
        desk: sends what is asked for.
        tell: told what is refused already here.
        show: shows or hides one of `SWITCHES` in the scene.
        rate: that the run was started with.

    Attributes:
        clock, phases, drones, sensors, acting, events: what is told in words.
        forms, plots: of each formation.
        chosen: the formation that is shown; empty where there is none.
        drone_form: knows the drone that is chosen.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        scenario: Scenario,
        spaces: Mapping[str, ClusterSpace],
        desk: CommandClient,
        tell: Callable[[RequestOutcome], None],
        show: Callable[[str, bool], None],
        rate: float,
    ) -> None:
        self._scenario = scenario
        self._spaces = spaces
        self._desk = desk
        self._tell = tell
        self._show = show
        self._rate = rate
        self.forms: dict[str, FormationForm] = {}
        self.plots: dict[str, VariablePlots] = {}
        self.chosen = next(iter(spaces), "")
        self._folders: dict[str, list[viser.GuiFolderHandle]] = {}
        self._set_theme(gui)
        self._right_panel(gui)
        self._left_panel(gui)

    def _set_theme(self, gui: viser.GuiApi) -> None:
        gui.reset()
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.set_panel_label(f"zsim {self._scenario.name}")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)

    def _right_panel(self, gui: viser.GuiApi) -> None:
        self.clock = gui.add_html("")
        self.phases = gui.add_html("")
        FleetForm(gui, self._desk, self._scenario)
        if len(self._spaces) > 1:
            choice = gui.add_dropdown("formation", list(self._spaces))
            choice.on_update(lambda _: self._show_formation(choice.value))
        tabs = gui.add_tab_group()
        if self._spaces:
            self._formation_tabs(gui, tabs)
        with tabs.add_tab("Faults"):
            self.acting = gui.add_html("")
            FaultForm(gui, self._desk, self._tell, self._scenario)
        with tabs.add_tab("Run"):
            RunForm(gui, self._desk, self._rate)
            self._switches(gui)

    def _formation_tabs(self, gui: viser.GuiApi, tabs: Any) -> None:
        """Give every formation its place in two tabs; only that of the chosen one is seen."""
        fly, plots = tabs.add_tab("Fly"), tabs.add_tab("Plots")
        for cluster in self._scenario.clusters:
            name, space = cluster.name, self._spaces[cluster.name]
            found = slider_ranges(space, cluster, self._scenario)
            with fly, gui.add_folder(None, visible=name == self.chosen) as place:
                self.forms[name] = FormationForm(gui, self._desk, self._tell, cluster, space, found)
            with plots, gui.add_folder(None, visible=name == self.chosen) as other:
                self.plots[name] = VariablePlots(gui, space, found)
            self._folders[name] = [place, other]

    def _show_formation(self, chosen: str) -> None:
        self.chosen = chosen
        for name, places in self._folders.items():
            for place in places:
                place.visible = name == chosen

    def _switches(self, gui: viser.GuiApi) -> None:
        for what, label in SWITCHES.items():
            switch = gui.add_checkbox(label, True)
            switch.on_update(lambda _, what=what, switch=switch: self._show(what, switch.value))

    def _left_panel(self, gui: viser.GuiApi) -> None:
        panel = gui.add_panel()
        with panel.add_tab("Drones", viser.Icon.DRONE):
            self.drones = gui.add_html("")
            self.drone_form = DroneForm(gui, self._desk, self._scenario)
            self.sensors = gui.add_html("")
        with panel.add_tab("Events", viser.Icon.LIST):
            self.events = gui.add_html("")
        panel.dock_left()
        panel.set_width(PANEL_PX)
