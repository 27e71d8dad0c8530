"""Controls of one formation: its phases, sliders of its variables, and trajectories."""

import threading
import time
from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any, NamedTuple

import numpy as np
import viser

from zsim.contract.flight_messages import ViewCluster
from zsim.scenario.scenario import Cluster, Trajectory
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.console_tables import preflight_lines
from zsim_bridges.console.operator_input import (
    InputError,
    SliderRange,
    is_apart,
    parse_expressions,
    parse_waypoints,
    primary_variables,
    range_refusal,
    waypoints_from,
)
from zsim_bridges.console.orders import CommandClient, RequestOutcome
from zsim_bridges.console.picture import SHAPED_PHASES, FlightPreview, PreviewError, preview_of
from zsim_bridges.console.run_condition import RunCondition, formation_refusals, is_held_by_fault
from zsim_bridges.console.run_forms import (
    ORDERS,
    OrderButton,
    assign,
    limits_line,
    offered,
    refusal_lines,
    set_refusals,
)

PREVIEW_STYLE = "font-size:12px;line-height:1.3;padding:2px 10px;color:#d9480f"
REST_S = 1.0  # wall; sliders must rest this long before their values are sent, since people type slowly
STILL_S = 2.0  # wall; if a formation's goal has not changed for this long, it is not moving: the slider shows its goal
OVER_MAX_S = 3600.0  # simulated; of a move, as controllers take it
OPERATIONS = {"Take off": "takeoff", "Engage": "engage", "Hold": "hold", "Rejoin": "rejoin", "Land": "land"}
SAFE = ("hold", "land")  # operations that need no control
RETURN = "Return"  # above the middle of the starts, to land there
LABELS = {
    **{op: label for label, op in OPERATIONS.items()},
    "target": "sliders",
    "trajectory": "Trajectory",
    "return": RETURN,
}
ICONS = {
    "takeoff": viser.Icon.PLANE_DEPARTURE,
    "engage": viser.Icon.TRIANGLE,
    "rejoin": viser.Icon.ARROWS_JOIN,
}
EXPRESSIONS = "x_c = 5 + 3*cos(0.1*t)\nyaw = 90 + 6*t"
WAYPOINTS = "0: x_c = 5, y_c = 0\n20: x_c = 5, y_c = 6"
EXPRESSION_UNITS = "t in seconds, lengths in metres, angles in degrees as on the sliders; sin and cos are of radians"
WAYPOINT_UNITS = "seconds from the start, lengths in metres, angles in degrees as on the sliders"


class _Flight(NamedTuple):
    """A request for a target or trajectory."""

    op: str
    shown: str  # the arguments as the page shows them
    args: dict[str, Any]  # in SI units


class FormationForm:
    """Controls of one formation.

    Args:
        report: called with the outcome of requests that are refused here.
        request_return: lets a formation move over the middle of its starts, and land.
        show_preview: shows in the scene the path that would be flown; None: nothing.

    Attributes:
        safe: the controls that a page may use without being in control.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        client: CommandClient,
        report: Callable[[RequestOutcome], None],
        cluster: Cluster,
        space: ClusterSpace,
        ranges: list[SliderRange],
        request_return: Callable[[str], None] = lambda _: None,
        show_preview: Callable[[FlightPreview | None], None] = lambda _: None,
    ) -> None:
        self._show_preview = show_preview
        self._client = client
        self._report = report
        self._cluster = cluster
        self._space = space
        self._ranges = {each.name: each for each in ranges}
        self._previewed: _Flight | None = None
        self._shown: tuple[float, ...] | None = None  # where the formation is desired to be
        self._written: tuple[float, ...] | None = None  # where the prefilled waypoints begin
        self._edited = False
        self._controls: dict[str, Any] = {}
        for label, op in OPERATIONS.items():
            if op in ORDERS:
                self._controls[op] = OrderButton(gui, label, op, {"cluster": cluster.name})
            else:
                colour = "blue" if op in ("takeoff", "engage") else "gray"
                self._controls[op] = button = gui.add_button(label, icon=ICONS[op], color=colour)
                button.on_click(lambda _, op=op: client.request_cluster(cluster.name, op))
        self.safe = [self._controls[op] for op in SAFE]
        if {"x_c", "y_c"} <= set(space.names):
            back = gui.add_button(RETURN, icon=viser.Icon.HOME, color="gray")
            back.on_click(lambda _: request_return(cluster.name))
            self._controls["return"] = back
        self._reasons = gui.add_html("")
        self._checks = gui.add_html("")
        self._others: list[tuple[str, Any]] = []  # further controls, with the operation that each requests
        hint = "Duration of a move; 0: as fast as the robots' limits allow"
        self._over = gui.add_number("over [s]", 0.0, min=0.0, max=OVER_MAX_S, step=0.5, hint=hint)
        gui.add_html(limits_line(f"over: 0 to {OVER_MAX_S:g} s"))
        hint = "Preview the path of a target or trajectory, and ask before it is flown"
        self._first = gui.add_checkbox("Preview first", False, hint=hint)
        self._preview_text = gui.add_html("", visible=False)
        self._fly_it = gui.add_button("Fly what is previewed", icon=viser.Icon.PLAYER_PLAY, color="blue", visible=False)
        self._fly_it.on_click(lambda _: self._end_preview(fly=True))
        self._discard = gui.add_button("Discard it", color="gray", visible=False)
        self._discard.on_click(lambda _: self._end_preview(fly=False))
        shown = primary_variables(space.names)
        self._sliders = {name: VariableSlider(gui, self._ranges[name]) for name in shown}
        if len(shown) < space.size:
            self._single_variable(gui, [name for name in space.names if name not in shown])
        self._trajectories(gui, cluster.plan.trajectory)

    def offer(self, run: RunCondition) -> None:
        """Disable, with the reason, what the controller would refuse; sliders still show the formation's state."""
        name = self._cluster.name
        refusals = offered(run, partial(formation_refusals, cluster=name))
        refusals["return"] = refusals["target"]  # its first part
        set_refusals(self._controls, refusals)
        for op, control in self._others:
            set_refusals({op: control}, refusals)
        assign(self._controls["rejoin"], visible=is_held_by_fault(run, name))
        for slider in self._sliders.values():
            slider.lock(bool(refusals["target"]))
        shown = {op: label for op, label in LABELS.items() if op != "rejoin" or self._controls[op].visible}
        self._reasons.content = refusal_lines(shown, refusals)
        landed = [each for each in self._cluster.drones if each in run.checks and run.drones.get(each) == "landed"]
        checks = {drone: run.checks[drone] for drone in landed}
        self._checks.content = preflight_lines(checks) if checks and not run.grounded() else ""

    def refresh(self, view: ViewCluster | None, wall_s: float) -> None:
        """Let sliders that were not moved, and waypoints that were not edited, follow the formation."""
        if view is None:
            return
        shown = view.desired if view.phase in SHAPED_PHASES else view.value
        before, self._shown = self._shown, tuple(shown)
        if not self._edited:
            ranges, written = list(self._ranges.values()), self._written
            if self._shown == before or written is None or is_apart(self._shown, written, ranges):
                self._prefill()
        for name, slider in self._sliders.items():
            slider.follow(shown[self._space.index(name)], wall_s)

    def send(self, wall_s: float) -> None:
        """Request the values of all moved sliders together, once none is moving."""
        moves = [slider.moved for slider in self._sliders.values()]
        if wall_s - max((move[1] for move in moves if move is not None), default=wall_s) < REST_S:
            return
        moved = {name: value for name, slider in self._sliders.items() if (value := slider.pop_value()) is not None}
        if self.request_target(moved):
            for name in moved:
                self._sliders[name].hold(wall_s)  # a previewed one returns without a request

    def request_target(self, shown: dict[str, float]) -> bool:
        """Request values in the units of the page; return whether they are within their ranges."""
        over_s = float(self._over.value)
        asked = [self._ranges[name].refusal(value) for name, value in shown.items()]
        refusals = [each for each in (*asked, range_refusal("over", over_s, 0.0, OVER_MAX_S, "s")) if each]
        if refusals and shown:
            self._report(RequestOutcome(f"{self._cluster.name}: target", "; ".join(refusals)))
            return False
        values = {name: self._ranges[name].to_si(value) for name, value in shown.items()}
        lasting: dict[str, Any] = {"over_s": over_s} if over_s > 0 else {}
        text = ", ".join(f"{name} {value:g} {self._ranges[name].unit}" for name, value in shown.items())
        self._request(_Flight("target", text, {"values": values, **lasting}))
        return True

    def _request(self, flight: _Flight) -> None:
        """Request a flight, or preview it first."""
        if not self._first.value or self._shown is None:
            self._end_preview(fly=False)
            self._send(flight)
            return
        op, shown, args = flight
        if op == "target" and self._previewed is not None and self._previewed.op == op:  # of sliders moved one by one
            shown = f"{self._previewed.shown}, {shown}"
            args = {**args, "values": {**self._previewed.args["values"], **args["values"]}}
        apart_m = self._cluster.gains.separation_min_m
        try:
            preview = preview_of(self._space, op, args, np.array(self._shown), apart_m)
        except PreviewError as error:
            self._report(RequestOutcome(f"{self._cluster.name}: {op}", str(error)))
            return
        self._previewed = _Flight(op, shown, args)
        self._show_preview(preview)
        self._preview_text.content = f"<div style='{PREVIEW_STYLE}'>{escape(f'{op} {shown}: {preview.text}')}</div>"
        self._preview_text.visible = self._fly_it.visible = self._discard.visible = True

    def _end_preview(self, fly: bool) -> None:
        previewed, self._previewed = self._previewed, None
        if previewed is None:
            return
        self._preview_text.visible = self._fly_it.visible = self._discard.visible = False
        self._show_preview(None)
        if fly:
            self._send(previewed)

    def _send(self, flight: _Flight) -> None:
        self._client.request_cluster(self._cluster.name, flight.op, shown=flight.shown, **flight.args)

    def _other_button(self, gui: viser.GuiApi, op: str, label: str, act: Callable[[], Any]) -> None:
        button = gui.add_button(label)
        button.on_click(lambda _: act())
        self._others.append((op, button))

    def _single_variable(self, gui: viser.GuiApi, names: list[str]) -> None:
        def label_of(name: str) -> str:
            allowed = self._ranges[name]
            return f"value [{allowed.unit}], {allowed.low:g} to {allowed.high:g}"

        with gui.add_folder("Other variables", expand_by_default=False):
            name = gui.add_dropdown("variable", names)
            value = gui.add_number(label_of(names[0]), 0.0, step=0.1)
            name.on_update(lambda _: setattr(value, "label", label_of(name.value)))
            request = lambda: self.request_target({name.value: float(value.value)})  # noqa: E731
            self._other_button(gui, "target", "Move it", request)

    def _trajectories(self, gui: viser.GuiApi, planned: Trajectory | None) -> None:
        angles = [each.name for each in self._ranges.values() if each.unit == "deg"]
        names = self._space.names

        def on_edit(event: viser.GuiEvent[Any]) -> None:
            self._edited = self._edited or event.client_id is not None

        add = partial(self._other_button, gui, "trajectory")
        with gui.add_folder("Trajectory", expand_by_default=False):
            if planned is not None:
                flown: dict[str, Any] = {"expressions": planned.expressions, "constants": planned.constants}
                if planned.waypoints:
                    flown = {"waypoints": [{"at_s": each.at_s, "values": each.values} for each in planned.waypoints]}
                add("Fly the scenario's", lambda: self._fly(lambda: flown))
            gui.add_markdown(f"<sub>{EXPRESSION_UNITS}</sub>")
            text = gui.add_text("expressions [m, deg]", EXPRESSIONS, multiline=True)
            add("Fly the expressions", lambda: self._fly(lambda: parse_expressions(text.value, names, angles)))
            gui.add_markdown(f"<sub>{WAYPOINT_UNITS}</sub>")
            points = self._points = gui.add_text("waypoints [s, m, deg]", WAYPOINTS, multiline=True)
            points.on_update(on_edit)
            add("Waypoints from here", self._prefill)
            add("Fly the waypoints", lambda: self._fly(lambda: parse_waypoints(points.value, self._ranges)))

    def _prefill(self) -> None:
        """Fill in the formation's place as the first waypoint, and again as the second, to be edited.

        The waypoints then follow the formation until they are edited.
        """
        if self._shown is None:
            return
        self._edited, self._written = False, self._shown
        assign(self._points, value=waypoints_from(self._shown, list(self._ranges.values())))

    def _fly(self, read: Callable[[], dict[str, Any]]) -> None:
        try:
            args = read()
        except InputError as error:
            self._report(RequestOutcome(f"{self._cluster.name}: trajectory", str(error)))
            return
        self._request(_Flight("trajectory", "", args))


class _HeldValue(NamedTuple):
    value: float  # of a slider that was moved
    goal: float  # of the formation
    since_s: float  # since when that is the goal [wall]


class VariableSlider:
    """A slider of one cluster variable; all values here are in the unit of its range.

    It follows the formation while no operator moves it.
    """

    def __init__(self, gui: viser.GuiApi, range_: SliderRange) -> None:
        self._range = range_
        self._lock = threading.Lock()
        self.moved: tuple[float, float] | None = None  # by an operator, to which value, and when [s; wall]
        self._held: _HeldValue | None = None
        self._slider: Any = gui.add_slider(range_.label, range_.low, range_.high, range_.step, range_.start)
        self._slider.label = f"{range_.label}: not known"
        self._slider.on_update(self._on_update)

    def lock(self, locked: bool) -> None:
        assign(self._slider, disabled=locked)

    def pop_value(self) -> float | None:
        """Return, once, the value to which it was moved; None if it was not."""
        with self._lock:
            moved, self.moved = self.moved, None
        return None if moved is None else moved[0]

    def hold(self, wall_s: float) -> None:
        """Keep its value while the formation moves there."""
        self._held = _HeldValue(float(self._slider.value), float("nan"), wall_s)

    def follow(self, goal: float, wall_s: float) -> None:
        """Show the formation's goal [m, rad], unless it was moved and the formation is on its way.

        The slider extends to the value that it shows; requests remain limited to the range.
        """
        shown = self._range.to_display(goal)
        if self.moved is not None or self._is_held(shown, wall_s):
            return
        low, high = min(self._range.low, shown), max(self._range.high, shown)
        if (self._slider.min, self._slider.max) != (low, high):
            self._slider.min, self._slider.max = low, high
        self._slider.value = shown
        assign(self._slider, label=self._range.label_of(goal))

    def _is_held(self, goal: float, wall_s: float) -> bool:
        kept = self._held
        if kept is None:
            return False
        if goal != kept.goal:
            self._held = kept._replace(goal=goal, since_s=wall_s)
        elif goal == kept.value or wall_s - kept.since_s > STILL_S:
            self._held = None
        return self._held is not None

    def _on_update(self, event: viser.GuiEvent[Any]) -> None:
        if event.client_id is None:
            return  # set by `follow`
        with self._lock:
            self.moved = float(self._slider.value), time.monotonic()
