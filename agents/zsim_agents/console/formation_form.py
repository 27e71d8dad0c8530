"""Steering of one formation: phases, sliders of its variables, trajectories."""

import threading
import time
from collections.abc import Callable
from typing import Any

import viser

from zsim.messages import ViewCluster
from zsim.scenario import Cluster, Trajectory
from zsim_agents.cluster_space import ClusterSpace
from zsim_agents.console import typed
from zsim_agents.console.desk import Desk, Told
from zsim_agents.console.limits import Range, foremost
from zsim_agents.console.picture import SHAPED

QUIET_S = 0.3  # wall; for so long a slider must rest before its value is sent
REST_S = 2.0  # wall; for so long after a move a slider is not taken back to where the formation is to be
OVER_S = 5.0  # simulated; of a move, unless another is typed
OPERATIONS = {"Take off": "takeoff", "Engage": "engage", "Hold": "hold", "Land": "land"}
ICONS = {
    "takeoff": viser.Icon.PLANE_DEPARTURE,
    "engage": viser.Icon.TRIANGLE,
    "hold": viser.Icon.HAND_STOP,
    "land": viser.Icon.PLANE_ARRIVAL,
}
EXAMPLES = {"expressions": "x_c = 5 + 3*cos(0.1*t)", "waypoints": "0: x_c = 5, y_c = 0\n20: x_c = 5, y_c = 6"}
Tell = Callable[[Told], None]


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
        self, gui: viser.GuiApi, desk: Desk, tell: Tell, cluster: Cluster, space: ClusterSpace, ranges: list[Range]
    ) -> None:
        self._desk = desk
        self._tell = tell
        self._cluster = cluster
        self._space = space
        self._ranges = {each.name: each for each in ranges}
        self._lock = threading.Lock()
        self._moved: dict[str, tuple[float, float]] = {}  # what was moved, to where, and when on the wall
        self._kept_s: dict[str, float] = {}  # until when on the wall a slider is left where it was put
        for label, op in OPERATIONS.items():
            self._button(gui, label, op)
        self._over = gui.add_number("over [s]", OVER_S, min=0.1, max=600.0, step=0.5, hint="Duration of a move")
        shown = foremost(space.names)
        self._sliders = {name: self._slider(gui, self._ranges[name]) for name in shown}
        if len(shown) < space.size:
            self._one_of_many(gui, [name for name in space.names if name not in shown])
        self._trajectories(gui, cluster.plan.trajectory)

    def refresh(self, view: ViewCluster | None, wall_s: float) -> None:
        """Let the sliders that nobody moves follow the formation."""
        if view is None:
            return
        shown = view.desired if view.phase in SHAPED else view.value
        for name, slider in self._sliders.items():
            if name not in self._moved and wall_s > self._kept_s.get(name, 0.0):
                slider.value = self._ranges[name].shown(shown[self._space.index(name)])

    def send(self, wall_s: float) -> None:
        """Ask for what the sliders that have come to rest show."""
        with self._lock:
            moved = self._moved
            if not moved or wall_s - max(at_s for _, at_s in moved.values()) < QUIET_S:
                return
            self._moved = {}
        for name in moved:
            self._kept_s[name] = wall_s + REST_S + float(self._over.value)
        self.target({name: value for name, (value, _) in moved.items()})

    def target(self, shown: dict[str, float]) -> None:
        """Ask for values as they are shown."""
        refusals = [refusal for name, value in shown.items() if (refusal := self._ranges[name].refusal(value))]
        if refusals:
            self._tell(Told(f"{self._cluster.name}: target", "; ".join(refusals)))
            return
        values = {name: self._ranges[name].meant(value) for name, value in shown.items()}
        self._desk.cluster(self._cluster.name, "target", values=values, over_s=float(self._over.value))

    def _button(self, gui: viser.GuiApi, label: str, op: str) -> None:
        button = gui.add_button(label, icon=ICONS[op], color="blue" if op in ("takeoff", "engage") else "gray")
        button.on_click(lambda _: self._desk.cluster(self._cluster.name, op))

    def _slider(self, gui: viser.GuiApi, range_: Range) -> Any:
        start = range_.shown(0.0)
        slider = gui.add_slider(range_.label, range_.low, range_.high, range_.step, start)

        def moved(event: viser.GuiEvent[Any]) -> None:
            if event.client_id is not None:  # by a person, not by `refresh`
                with self._lock:
                    self._moved[range_.name] = (float(slider.value), time.monotonic())

        slider.on_update(moved)
        return slider

    def _one_of_many(self, gui: viser.GuiApi, names: list[str]) -> None:
        with gui.add_folder("Other variables", expand_by_default=False):
            name = gui.add_dropdown("variable", names)
            value = gui.add_number("value [m or deg]", 0.0, step=0.1)
            gui.add_button("Move it").on_click(lambda _: self.target({name.value: float(value.value)}))

    def _trajectories(self, gui: viser.GuiApi, planned: Trajectory | None) -> None:
        with gui.add_folder("Trajectory", expand_by_default=False):
            if planned is not None:
                gui.add_button("Fly the scenario's").on_click(lambda _: self._fly(lambda: _planned(planned)))
            gui.add_markdown("<sub>t in seconds, lengths in metres, angles in radians</sub>")
            text = gui.add_text("expressions", EXAMPLES["expressions"], multiline=True)
            fly = gui.add_button("Fly the expressions")
            fly.on_click(lambda _: self._fly(lambda: typed.expressions(text.value, self._space.names)))
            points = gui.add_text("waypoints", EXAMPLES["waypoints"], multiline=True)
            gui.add_button("Fly the waypoints").on_click(lambda _: self._fly(lambda: typed.waypoints(points.value)))

    def _fly(self, read: Callable[[], dict[str, Any]]) -> None:
        try:
            args = read()
        except typed.TypedError as error:
            self._tell(Told(f"{self._cluster.name}: trajectory", str(error)))
            return
        self._desk.cluster(self._cluster.name, "trajectory", **args)


def _planned(trajectory: Trajectory) -> dict[str, Any]:
    if trajectory.waypoints:
        return {"waypoints": [{"at_s": point.at_s, "values": point.values} for point in trajectory.waypoints]}
    return {"expressions": trajectory.expressions, "constants": trajectory.constants}
