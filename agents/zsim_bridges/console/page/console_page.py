"""The page's panels: plots, forms and tables of one run."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import viser
from viser import uplot

from zsim.contract.messages import DroneInfo
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.command_client import CommandClient, RequestOutcome
from zsim_bridges.console.page.formation_form import FormationForm
from zsim_bridges.console.page.operator_input import SliderRange, slider_ranges
from zsim_bridges.console.page.page_forms import set_theme
from zsim_bridges.console.page.picture import SERIES, SPAN_S, VariableHistory
from zsim_bridges.console.page.run_forms import FaultForm, FleetForm, RunForm
from zsim_bridges.console.run_condition import RunCondition

PLOTS_SHOWN = 3  # plots
COLOURS = ("#868e96", "#1971c2", "#e8590c")  # of SERIES
HEIGHT_PX = 150
AXIS_PX = 56  # of figures such as -12.5, which would be clipped
NONE = "none"


class VariablePlots:
    """Plots of one formation, three variables at a time.

    Args:
        gui: viser's, in the folder where they are to be.
        space: of the formation.
        ranges: of its variables.
    """

    def __init__(self, gui: viser.GuiApi, space: ClusterSpace, ranges: list[SliderRange]) -> None:
        self.history = VariableHistory(space.size)
        self._ranges = ranges
        self._in_degrees = [each.unit == "deg" for each in ranges]
        self._choices = {_title(ranges[k : k + PLOTS_SHOWN]): k for k in range(0, len(ranges), PLOTS_SHOWN)}
        self._choice = gui.add_dropdown("variables", [NONE, *self._choices], initial_value=next(iter(self._choices)))
        gui.add_markdown(f"<sub>{_legend()} over time [s], the last {SPAN_S:g} s</sub>")
        self._plots = [_plot(gui, each) for each in ranges[:PLOTS_SHOWN]]
        self._first: int | None = 0

    def draw(self) -> None:
        """Send the curves that are chosen."""
        first = self._choices.get(self._choice.value)
        if first != self._first:
            self._first = first
            self._retitle()
        if first is None:
            return
        for index, plot in enumerate(self._plots[: len(self._ranges) - first], start=first):
            curves = self.history.curves(index, self._in_degrees[index])
            if len(curves[0]) > 1:
                plot.data = curves

    def _retitle(self) -> None:
        shown = [] if self._first is None else self._ranges[self._first : self._first + PLOTS_SHOWN]
        for index, plot in enumerate(self._plots):
            plot.visible = index < len(shown)
            if plot.visible:
                plot.title = shown[index].label
                plot.data = tuple(np.zeros(2) for _ in range(1 + len(SERIES)))


def _title(ranges: list[SliderRange]) -> str:
    return ", ".join(each.name for each in ranges)


def _legend() -> str:
    return ", ".join(f"<span style='color:{c}'>{name}</span>" for name, c in zip(SERIES, COLOURS, strict=True))


def _plot(gui: viser.GuiApi, range_: SliderRange) -> Any:
    curves = [uplot.Series(label=n, stroke=c, width=1.5) for n, c in zip(SERIES, COLOURS, strict=True)]
    empty = tuple(np.array([0.0, 1.0]) for _ in range(1 + len(SERIES)))
    return gui.add_uplot(
        empty,
        (uplot.Series(label="t [s]"), *curves),
        title=range_.label,
        height=HEIGHT_PX,
        axes=(uplot.Axis(), uplot.Axis(size=AXIS_PX)),
        scales={"x": uplot.Scale(time=False, auto=True)},
        legend=uplot.Legend(show=False),
    )


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

    Attributes:
        phases, drones, faults: the tables.
        forms, plots: of each formation.
        chosen: the formation that is shown; empty where there is none.
        fleet: requests of all drones.
        drone_folder, figure_folder, event_folder, theme_folder: of what each page has for itself.
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
    ) -> None:
        self._scenario = scenario
        self._spaces = spaces
        self._client = client
        self._report = report
        self._show = show
        self._rate = rate
        self._drones = drones
        self.forms: dict[str, FormationForm] = {}
        self.plots: dict[str, VariablePlots] = {}
        self.chosen = next(iter(spaces), "")
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
        self.fleet = FleetForm(gui, self._client, self._scenario)
        if len(self._spaces) > 1:
            choice = gui.add_dropdown("formation", list(self._spaces))
            choice.on_update(lambda _: self._show_formation(choice.value))
        tabs = gui.add_tab_group()
        if self._spaces:
            self._formation_tabs(gui, tabs)
        with tabs.add_tab("Faults"):
            self.faults = gui.add_html("")
            FaultForm(gui, self._client, self._report, self._scenario, self._drones)
        with tabs.add_tab("Run"):
            self.run_form = RunForm(gui, self._client, self._rate)
            self._switches(gui)
            self.theme_folder = gui.add_folder(None)

    def _formation_tabs(self, gui: viser.GuiApi, tabs: Any) -> None:
        """Give every formation a folder in two tabs; only that of the chosen one is visible."""
        fly, plots = tabs.add_tab("Fly"), tabs.add_tab("Plots")
        for cluster in self._scenario.clusters:
            name, space = cluster.name, self._spaces[cluster.name]
            limits = slider_ranges(space, cluster, self._scenario)
            with fly, gui.add_folder(None, visible=name == self.chosen) as form_folder:
                self.forms[name] = FormationForm(gui, self._client, self._report, cluster, space, limits)
            with plots, gui.add_folder(None, visible=name == self.chosen) as plot_folder:
                self.plots[name] = VariablePlots(gui, space, limits)
            self._folders[name] = [form_folder, plot_folder]

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

    def _left_panel(self, gui: viser.GuiApi) -> None:
        panel = gui.add_panel()
        with panel.add_tab("Drones", viser.Icon.DRONE):
            self.drone_folder = gui.add_folder(None)
            self.drones = gui.add_html("")
            self.figure_folder = gui.add_folder(None)
        with panel.add_tab("Events", viser.Icon.LIST):
            self.event_folder = gui.add_folder(None)
        panel.dock_left()
        panel.set_width(PANEL_PX)
