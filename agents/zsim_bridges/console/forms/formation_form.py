"""Steering of one formation: phases, sliders of its variables, trajectories."""

from collections.abc import Callable
from typing import Any

import viser

from zsim.contract.messages import ViewCluster
from zsim.scenario.scenario import Cluster, Trajectory
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.command_client import CommandClient, RequestOutcome
from zsim_bridges.console.forms import form_input
from zsim_bridges.console.forms.slider_limits import SliderRange, primary_variables
from zsim_bridges.console.forms.variable_slider import VariableSlider
from zsim_bridges.console.scene.picture import SHAPED_PHASES

REST_S = 1.0  # wall; for so long sliders must rest before their values are sent: people type slowly
OVER_MAX_S = 3600.0  # simulated; of a move, as controllers take it
OPERATIONS = {"Take off": "takeoff", "Engage": "engage", "Hold": "hold", "Land": "land"}
ICONS = {
    "takeoff": viser.Icon.PLANE_DEPARTURE,
    "engage": viser.Icon.TRIANGLE,
    "hold": viser.Icon.HAND_STOP,
    "land": viser.Icon.PLANE_ARRIVAL,
}
EXAMPLES = {"expressions": "x_c = 5 + 3*cos(0.1*t)", "waypoints": "0: x_c = 5, y_c = 0\n20: x_c = 5, y_c = 6"}
Report = Callable[[RequestOutcome], None]


class FormationForm:
    """Controls of one formation.

    Args:
        gui: viser's, in the place where they are to be.
        desk: sends what is asked for.
        tell: told what is refused already here.
        cluster: of the scenario.
        space: of the formation.
        ranges: of its variables.
    """

    def __init__(
        self, gui: viser.GuiApi, desk: CommandClient, tell: Report, cluster: Cluster, space: ClusterSpace, ranges: list[SliderRange]
    ) -> None:
        self._desk = desk
        self._tell = tell
        self._cluster = cluster
        self._space = space
        self._ranges = {each.name: each for each in ranges}
        for label, op in OPERATIONS.items():
            self._button(gui, label, op)
        hint = "Duration of a move; 0: as fast as the robots' limits let it"
        self._over = gui.add_number("over [s]", 0.0, min=0.0, max=OVER_MAX_S, step=0.5, hint=hint)
        shown = primary_variables(space.names)
        self._sliders = {name: VariableSlider(gui, self._ranges[name]) for name in shown}
        if len(shown) < space.size:
            self._single_variable(gui, [name for name in space.names if name not in shown])
        self._trajectories(gui, cluster.plan.trajectory)

    def refresh(self, view: ViewCluster | None, wall_s: float) -> None:
        """Let the sliders that nobody moves follow the formation."""
        if view is None:
            return
        shown = view.desired if view.phase in SHAPED_PHASES else view.value
        for name, slider in self._sliders.items():
            slider.follow(shown[self._space.index(name)], wall_s)

    def send(self, wall_s: float) -> None:
        """Ask for what the sliders that have come to rest show."""
        moved_s = [slider.moved_s for slider in self._sliders.values()]
        if wall_s - max((at_s for at_s in moved_s if at_s is not None), default=wall_s) < REST_S:
            return
        moved = {name: value for name, slider in self._sliders.items() if (value := slider.pop_value()) is not None}
        if self.request_target(moved):
            for name in moved:
                self._sliders[name].hold(wall_s)

    def request_target(self, shown: dict[str, float]) -> bool:
        """Ask for values as they are shown; return whether they could be asked for."""
        refusals = [refusal for name, value in shown.items() if (refusal := self._ranges[name].refusal(value))]
        if refusals:
            self._tell(RequestOutcome(f"{self._cluster.name}: target", "; ".join(refusals)))
            return False
        values = {name: self._ranges[name].to_si(value) for name, value in shown.items()}
        lasting = {"over_s": float(self._over.value)} if self._over.value > 0 else {}
        said = ", ".join(f"{name} {value:g} {self._ranges[name].unit}" for name, value in shown.items())
        self._desk.request_cluster(self._cluster.name, "target", said=said, values=values, **lasting)
        return True

    def _button(self, gui: viser.GuiApi, label: str, op: str) -> None:
        button = gui.add_button(label, icon=ICONS[op], color="blue" if op in ("takeoff", "engage") else "gray")
        button.on_click(lambda _: self._desk.request_cluster(self._cluster.name, op))

    def _single_variable(self, gui: viser.GuiApi, names: list[str]) -> None:
        with gui.add_folder("Other variables", expand_by_default=False):
            name = gui.add_dropdown("variable", names)
            value = gui.add_number("value [m or deg]", 0.0, step=0.1)
            gui.add_button("Move it").on_click(lambda _: self._move(name.value, float(value.value)))

    def _move(self, name: str, shown: float) -> None:
        self.request_target({name: shown})

    def _trajectories(self, gui: viser.GuiApi, planned: Trajectory | None) -> None:
        with gui.add_folder("Trajectory", expand_by_default=False):
            if planned is not None:
                gui.add_button("Fly the scenario's").on_click(lambda _: self._fly(lambda: _planned_trajectory(planned)))
            gui.add_markdown("<sub>t in seconds, lengths in metres, angles in radians</sub>")
            text = gui.add_text("expressions", EXAMPLES["expressions"], multiline=True)
            fly = gui.add_button("Fly the expressions")
            fly.on_click(lambda _: self._fly(lambda: form_input.parse_expressions(text.value, self._space.names)))
            points = gui.add_text("waypoints", EXAMPLES["waypoints"], multiline=True)
            gui.add_button("Fly the waypoints").on_click(
                lambda _: self._fly(lambda: form_input.parse_waypoints(points.value))
            )

    def _fly(self, read: Callable[[], dict[str, Any]]) -> None:
        try:
            args = read()
        except form_input.InputError as error:
            self._tell(RequestOutcome(f"{self._cluster.name}: trajectory", str(error)))
            return
        self._desk.request_cluster(self._cluster.name, "trajectory", **args)


def _planned_trajectory(trajectory: Trajectory) -> dict[str, Any]:
    if trajectory.waypoints:
        return {"waypoints": [{"at_s": point.at_s, "values": point.values} for point in trajectory.waypoints]}
    return {"expressions": trajectory.expressions, "constants": trajectory.constants}
