"""Controls of one formation: buttons for its phases, sliders for its variables within ranges, and trajectories as text.

Pages show lengths in metres and angles in degrees; requests use metres and radians.
"""

import math
import re
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from html import escape
from typing import Any, NamedTuple

import numpy as np
import viser

from zsim.contract.flight_messages import ViewCluster
from zsim.scenario.scenario import Cluster, Drone, Scenario, Trajectory
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.trajectory import DEGREES
from zsim_bridges.console.console_tables import preflight_lines
from zsim_bridges.console.histories import shown_unit
from zsim_bridges.console.orders import CommandClient, RequestOutcome
from zsim_bridges.console.picture import SHAPED_PHASES, FlightPreview, PreviewError, preview_of
from zsim_bridges.console.run_condition import RunCondition, formation_refusals, is_held_by_fault
from zsim_bridges.console.run_forms import (
    ORDERS,
    InputError,
    OrderButton,
    assign,
    limits_line,
    offered_refusals,
    range_refusal,
    refusal_lines,
    set_refusals,
)

PREVIEW_STYLE = "font-size:12px;line-height:1.3;padding:2px 10px;color:#d9480f"
REST_S = 1.0  # wall; sliders must rest this long before their values are sent, since people type slowly
STILL_S = 2.0  # wall; if a formation's goal has not changed for this long, a moved slider shows the goal again
MOVE_DURATION_MAX_S = 3600.0  # simulated; maximum duration of a move that controllers accept
OPERATIONS = {"Take off": "takeoff", "Engage": "engage", "Hold": "hold", "Rejoin": "rejoin", "Land": "land"}
SAFE = ("hold", "land")  # operations that need no control
RETURN = "Return"  # the formation flies to above the middle of its drones' starts, and lands there
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
EXPRESSION_UNITS = "t in seconds, lengths in metres, angles in degrees as on the sliders; sin and cos take radians"
WAYPOINT_UNITS = "seconds from the start, lengths in metres, angles in degrees as on the sliders"
HORIZONTAL_RANGE_M = 50.0  # range around the drones' starts; design choice: as far as a page shows a formation well
HEIGHT_MIN_M, HEIGHT_MAX_M = 1.0, 30.0  # range of heights; design choice: clear of the ground, and within sight
SIDE_MAX_M = 20.0  # maximum side of a formation that a slider offers
DISPLACEMENT_M = 5.0  # maximum displacement of a robot from its position in a template that a slider offers
TILT_MAX_DEG = 29.0  # maximum tilt of a formation; controllers accept less than 30 (flight_check.py)
CORNER_MIN_DEG = 10.0  # minimum angle at a corner; at 0 and 180 degrees the robots are collinear
DIGITS = 6  # decimal digits of a displayed value: 5.1, not 5.1000000000000005
STEPS = {"m": 0.1, "deg": 1.0}
SLIDERS_MAX = 16  # up to this number, all variables have sliders; otherwise only those of the entire formation
WAYPOINT_STEP_S = 20.0  # time from the first to the second prefilled waypoint
PREFILLED = ("x_c", "y_c", "z_c", "yaw")  # variables in prefilled waypoints, if a formation has them


class _Flight(NamedTuple):
    """A request for a target or trajectory."""

    op: str
    args_text: str  # the arguments as the page shows them
    args: dict[str, Any]  # arguments of the request, in SI units


class FormationForm:
    """Controls of one formation.

    Args:
        report: called with the outcome of each request that is refused without being sent.
        request_return: moves a formation to above the middle of its drones' starts, and lands it there.
        show_preview: shows in the scene the path that would be flown; None: removes it.

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
        scenario: Scenario,
        request_return: Callable[[str], None] = lambda _: None,
        show_preview: Callable[[FlightPreview | None], None] = lambda _: None,
    ) -> None:
        self._show_preview = show_preview
        self._client = client
        self._report = report
        self._cluster = cluster
        self._space = space
        self._ranges = {each.name: each for each in slider_ranges(space, cluster, scenario)}
        self._previewed: _Flight | None = None
        self._shown: tuple[float, ...] | None = (
            None  # the formation's desired variables, or the estimated ones while it has no desired shape
        )
        self._prefilled: tuple[float, ...] | None = None  # the formation's variables when the waypoints were prefilled
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
            return_button = gui.add_button(RETURN, icon=viser.Icon.HOME, color="gray")
            return_button.on_click(lambda _: request_return(cluster.name))
            self._controls["return"] = return_button
        self._reasons = gui.add_html("")
        self._checks = gui.add_html("")
        self._extra_controls: list[tuple[str, Any]] = []  # further controls, with the operation that each requests
        hint = "Duration of a move; 0: as fast as the robots' limits allow"
        self._duration = gui.add_number("over [s]", 0.0, min=0.0, max=MOVE_DURATION_MAX_S, step=0.5, hint=hint)
        gui.add_html(limits_line(f"over: 0 to {MOVE_DURATION_MAX_S:g} s"))
        hint = "Preview the path of a target or trajectory, and confirm it before it is flown"
        self._preview_first = gui.add_checkbox("Preview first", False, hint=hint)
        self._preview_text = gui.add_html("", visible=False)
        self._fly_button = gui.add_button("Fly the preview", icon=viser.Icon.PLAYER_PLAY, color="blue", visible=False)
        self._fly_button.on_click(lambda _: self._end_preview(fly=True))
        self._discard_button = gui.add_button("Discard the preview", color="gray", visible=False)
        self._discard_button.on_click(lambda _: self._end_preview(fly=False))
        shown = primary_variables(space.names)
        self._sliders = {name: VariableSlider(gui, self._ranges[name]) for name in shown}
        if len(shown) < space.size:
            self._single_variable(gui, [name for name in space.names if name not in shown])
        self._trajectories(gui, cluster.plan.trajectory)

    def offer(self, run: RunCondition) -> None:
        """Disable what the controller would refuse, and show the reason; sliders still show the formation's state."""
        name = self._cluster.name
        refusals = offered_refusals(run, partial(formation_refusals, cluster=name))
        refusals["return"] = refusals["target"]  # a return begins with a target
        set_refusals(self._controls, refusals)
        for op, control in self._extra_controls:
            set_refusals({op: control}, refusals)
        assign(self._controls["rejoin"], visible=is_held_by_fault(run, name))
        for slider in self._sliders.values():
            slider.lock(bool(refusals["target"]))
        shown = {op: label for op, label in LABELS.items() if op != "rejoin" or self._controls[op].visible}
        self._reasons.content = refusal_lines(shown, refusals)
        landed = [each for each in self._cluster.drones if each in run.checks and run.drones.get(each) == "landed"]
        checks = {drone: run.checks[drone] for drone in landed}
        self._checks.content = preflight_lines(checks) if checks and not run.flight_refusal() else ""

    def refresh(self, view: ViewCluster | None, wall_s: float) -> None:
        """Let sliders that were not moved, and waypoints that were not edited, follow the formation."""
        if view is None:
            return
        shown = view.desired if view.phase in SHAPED_PHASES else view.value
        before, self._shown = self._shown, tuple(shown)
        if not self._edited:
            ranges, prefilled = list(self._ranges.values()), self._prefilled
            if self._shown == before or prefilled is None or differs_by_step(self._shown, prefilled, ranges):
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
                self._sliders[name].hold(wall_s)  # after a while, a slider that was only previewed shows the goal

    def request_target(self, shown: dict[str, float]) -> bool:
        """Request values in the units of the page; return whether they and the duration are within their ranges."""
        duration_s = float(self._duration.value)
        range_refusals = [self._ranges[name].refusal(value) for name, value in shown.items()]
        refusals = [
            each for each in (*range_refusals, range_refusal("over", duration_s, 0.0, MOVE_DURATION_MAX_S, "s")) if each
        ]
        if refusals and shown:
            self._report(RequestOutcome(f"{self._cluster.name}: target", "; ".join(refusals)))
            return False
        values = {name: self._ranges[name].to_si(value) for name, value in shown.items()}
        duration_args: dict[str, Any] = {"over_s": duration_s} if duration_s > 0 else {}
        text = ", ".join(f"{name} {value:g} {self._ranges[name].unit}" for name, value in shown.items())
        self._request(_Flight("target", text, {"values": values, **duration_args}))
        return True

    def _request(self, flight: _Flight) -> None:
        """Request a flight, or preview it first."""
        if not self._preview_first.value or self._shown is None:
            self._end_preview(fly=False)
            self._send(flight)
            return
        op, shown, args = flight
        if op == "target" and self._previewed is not None and self._previewed.op == op:  # extend the preview
            shown = f"{self._previewed.args_text}, {shown}"
            args = {**args, "values": {**self._previewed.args["values"], **args["values"]}}
        separation_min_m = self._cluster.gains.separation_min_m
        try:
            preview = preview_of(self._space, op, args, np.array(self._shown), separation_min_m)
        except PreviewError as error:
            self._report(RequestOutcome(f"{self._cluster.name}: {op}", str(error)))
            return
        self._previewed = _Flight(op, shown, args)
        self._show_preview(preview)
        self._preview_text.content = f"<div style='{PREVIEW_STYLE}'>{escape(f'{op} {shown}: {preview.text}')}</div>"
        self._preview_text.visible = self._fly_button.visible = self._discard_button.visible = True

    def _end_preview(self, fly: bool) -> None:
        previewed, self._previewed = self._previewed, None
        if previewed is None:
            return
        self._preview_text.visible = self._fly_button.visible = self._discard_button.visible = False
        self._show_preview(None)
        if fly:
            self._send(previewed)

    def _send(self, flight: _Flight) -> None:
        self._client.request_cluster(self._cluster.name, flight.op, args_text=flight.args_text, **flight.args)

    def _other_button(self, gui: viser.GuiApi, op: str, label: str, act: Callable[[], Any]) -> None:
        button = gui.add_button(label)
        button.on_click(lambda _: act())
        self._extra_controls.append((op, button))

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
                trajectory_args: dict[str, Any] = {"expressions": planned.expressions, "constants": planned.constants}
                if planned.waypoints:
                    trajectory_args = {
                        "waypoints": [{"at_s": each.at_s, "values": each.values} for each in planned.waypoints]
                    }
                add("Fly the scenario's", lambda: self._fly(lambda: trajectory_args))
            gui.add_markdown(f"<sub>{EXPRESSION_UNITS}</sub>")
            text = gui.add_text("expressions [m, deg]", EXPRESSIONS, multiline=True)
            add("Fly the expressions", lambda: self._fly(lambda: parse_expressions(text.value, names, angles)))
            gui.add_markdown(f"<sub>{WAYPOINT_UNITS}</sub>")
            points = self._points = gui.add_text("waypoints [s, m, deg]", WAYPOINTS, multiline=True)
            points.on_update(on_edit)
            add("Waypoints from here", self._prefill)
            add("Fly the waypoints", lambda: self._fly(lambda: parse_waypoints(points.value, self._ranges)))

    def _prefill(self) -> None:
        """Fill in the formation's position and yaw as both the first and the second waypoint, for the operator to edit.

        The waypoints then follow the formation until they are edited.
        """
        if self._shown is None:
            return
        self._edited, self._prefilled = False, self._shown
        assign(self._points, value=waypoints_from(self._shown, list(self._ranges.values())))

    def _fly(self, read: Callable[[], dict[str, Any]]) -> None:
        try:
            args = read()
        except InputError as error:
            self._report(RequestOutcome(f"{self._cluster.name}: trajectory", str(error)))
            return
        self._request(_Flight("trajectory", "", args))


class _HeldValue(NamedTuple):
    value: float  # the value to which the slider was moved
    goal: float  # the formation's last goal
    since_s: float  # when that became the goal [s; wall]


class VariableSlider:
    """A slider of one cluster variable, which follows the formation while no operator moves it.

    Values are in the unit of the slider's range, unless stated otherwise.
    """

    def __init__(self, gui: viser.GuiApi, range_: "SliderRange") -> None:
        self._range = range_
        self._lock = threading.Lock()
        self.moved: tuple[float, float] | None = None  # the value to which an operator moved it, and when [s; wall]
        self._held: _HeldValue | None = None
        self._slider: Any = gui.add_slider(range_.label, range_.low, range_.high, range_.step, range_.start)
        self._slider.label = f"{range_.label}: unknown"
        self._slider.on_update(self._on_update)

    def lock(self, locked: bool) -> None:
        assign(self._slider, disabled=locked)

    def pop_value(self) -> float | None:
        """Return the value to which the slider was moved, once; None if it was not moved."""
        with self._lock:
            moved, self.moved = self.moved, None
        return None if moved is None else moved[0]

    def hold(self, wall_s: float) -> None:
        """Keep the slider's value while the formation moves to it."""
        self._held = _HeldValue(float(self._slider.value), float("nan"), wall_s)

    def follow(self, goal: float, wall_s: float) -> None:
        """Show the formation's goal [m, rad], unless the slider's value is yet to be sent or reached.

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
        held = self._held
        if held is None:
            return False
        if goal != held.goal:
            self._held = held._replace(goal=goal, since_s=wall_s)
        elif goal == held.value or wall_s - held.since_s > STILL_S:
            self._held = None
        return self._held is not None

    def _on_update(self, event: viser.GuiEvent[Any]) -> None:
        if event.client_id is None:
            return  # set by `follow`
        with self._lock:
            self.moved = float(self._slider.value), time.monotonic()


class SliderRange(NamedTuple):
    """The range of a cluster variable on a slider, in its unit, m or deg."""

    name: str
    unit: str
    low: float
    high: float
    step: float

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit}]"

    @property
    def start(self) -> float:
        """Position of the slider while the variable is unknown."""
        return min(max(0.0, self.low), self.high)

    def in_unit(self, value: float) -> float:
        """Return a value [m, rad] in the unit of the range; angles within ±180 degrees."""
        return math.degrees(math.remainder(value, math.tau)) if self.unit == "deg" else value

    def to_si(self, shown: float) -> float:
        return math.radians(shown) if self.unit == "deg" else shown

    def to_display(self, value: float) -> float:
        """Return a value [m, rad] in the unit of the range, rounded to its step.

        A value beyond a limit by up to half a step becomes the limit, which need not be a multiple of the step: the
        limits of sides come from the scenario.
        """
        shown = self.in_unit(value)
        rounded = round(round(shown / self.step) * self.step, DIGITS)
        clamped = min(max(rounded, self.low), self.high)
        return clamped if abs(shown - clamped) <= self.step / 2.0 else rounded

    def label_of(self, value: float) -> str:
        """Return the label, with the value [m, rad] if that is out of range."""
        shown, tolerance = self.in_unit(value), self.step / 2.0
        if self.low - tolerance <= shown <= self.high + tolerance:
            return self.label
        return f"{self.name} = {shown:.1f} {self.unit}: out of range"

    def refusal(self, shown: float) -> str | None:
        """Return why a value, in the unit of the range, may not be requested; None if it may."""
        return range_refusal(self.name, shown, self.low, self.high, self.unit)


def height_range_m(drones: Iterable[Drone]) -> tuple[float, float]:
    """Return the range of heights to which drones may be sent; it ends at or below the lowest of their ceilings."""
    top_m = min(HEIGHT_MAX_M, *(drone.limits.altitude_m for drone in drones))
    return min(HEIGHT_MIN_M, top_m / 2.0), top_m


def slider_ranges(space: ClusterSpace, cluster: Cluster, scenario: Scenario) -> list[SliderRange]:
    """Return the ranges of all variables of a formation, in the space's order."""
    drones = [scenario.drone(name) for name in cluster.drones]
    x, y = (round(sum(drone.position_m[axis] for drone in drones) / len(drones)) for axis in range(2))
    separation_min_m = max(cluster.gains.separation_min_m, STEPS["m"])
    side = (separation_min_m, max(SIDE_MAX_M, 2.0 * separation_min_m))
    bounds = {
        "x_c": (x - HORIZONTAL_RANGE_M, x + HORIZONTAL_RANGE_M),
        "y_c": (y - HORIZONTAL_RANGE_M, y + HORIZONTAL_RANGE_M),
        "z_c": height_range_m(drones),
        **dict.fromkeys(("p", "q", "rho"), side),
        **dict.fromkeys(("roll", "pitch", "elevation"), (-TILT_MAX_DEG, TILT_MAX_DEG)),
        "beta": (CORNER_MIN_DEG, 180.0 - CORNER_MIN_DEG),
    }
    ranges = []
    for name in space.names:
        unit = shown_unit(name)
        default = (-180.0, 180.0) if unit == "deg" else (-DISPLACEMENT_M, DISPLACEMENT_M)
        stem = name.rpartition(".")[2].rstrip("0123456789").rstrip("_")
        low, high = bounds.get(name) or bounds.get(stem) or default
        ranges.append(SliderRange(name, unit, float(low), float(high), STEPS[unit]))
    return ranges


def primary_variables(names: Sequence[str]) -> list[str]:
    """Return the variables with sliders: all, up to SLIDERS_MAX; otherwise those of the whole formation."""
    primary = ("x_c", "y_c", "z_c", "roll", "pitch", "yaw", "p", "q", "beta")
    return list(names) if len(names) <= SLIDERS_MAX else [name for name in names if name in primary]


def parse_expressions(text: str, names: Sequence[str], angles: Collection[str] = ()) -> dict[str, Any]:
    """Return the arguments of a trajectory given as lines `variable = expression`; other names are constants.

    Args:
        names: names of the formation's variables.
        angles: names of those whose expressions are in degrees; `NAME_deg` is the same as `NAME`.

    Raises:
        InputError: a line is neither an expression nor a used constant, or there is no expression.
    """
    by_variable: dict[str, str] = {}
    constants: dict[str, float] = {}
    for number, line in _lines(text):
        name, equals, value = (part.strip() for part in line.partition("="))
        if not equals or not name or not value:
            allowed = "VARIABLE = EXPRESSION, such as x_c = 5*cos(0.1*t)"
            raise InputError(f"line {number} is {line[:40]!r}; must be {allowed}")
        variable = name.removesuffix(DEGREES)
        if variable in angles:
            by_variable[f"{variable}{DEGREES}"] = value
        elif name in names:
            by_variable[name] = value
        else:
            constants[name] = _number(value, f"line {number}: {name}, a constant, since it is not a variable,")
    if not by_variable:
        raise InputError("trajectory is empty; must have at least one line VARIABLE = EXPRESSION")
    for name in constants:
        if not any(re.search(rf"\b{re.escape(name)}\b", expression) for expression in by_variable.values()):
            raise InputError(f"{name} is neither a variable nor used as a constant; variables are {', '.join(names)}")
    return {"expressions": by_variable, "constants": constants}


def parse_waypoints(text: str, ranges: Mapping[str, SliderRange]) -> dict[str, Any]:
    """Return the arguments of a trajectory given as lines `seconds: variable = value, …` in the ranges' units.

    Raises:
        InputError: a line has another form, or there are no lines.
    """
    points = []
    for number, line in _lines(text):
        time_text, colon, rest = line.partition(":")
        pairs = [
            (name.strip(), equals, value) for name, equals, value in (pair.partition("=") for pair in rest.split(","))
        ]
        if not colon or not all(name and equals for name, equals, _ in pairs):
            raise InputError(f"line {number} is {line[:40]!r}; must be SECONDS: VARIABLE = VALUE, VARIABLE = VALUE, …")
        shown = {name: _number(value, f"line {number}: {name}") for name, _, value in pairs}
        values = {name: ranges[name].to_si(value) if name in ranges else value for name, value in shown.items()}
        points.append({"at_s": _number(time_text, f"line {number}: the time"), "values": values})
    if not points:
        raise InputError("waypoints are empty; must have at least one line SECONDS: VARIABLE = VALUE")
    return {"waypoints": points}


def waypoints_from(value: Sequence[float], ranges: Sequence[SliderRange]) -> str:
    """Return two waypoints at the present values of a formation's variables, in the units of the page."""
    pairs = [
        f"{each.name} = {round(each.in_unit(present), 2):g}"
        for each, present in zip(ranges, value, strict=True)
        if each.name in PREFILLED
    ]
    return "\n".join(f"{at_s:g}: {', '.join(pairs)}" for at_s in (0.0, WAYPOINT_STEP_S))


def differs_by_step(value: Sequence[float], other: Sequence[float], ranges: Sequence[SliderRange]) -> bool:
    """Return whether the prefilled waypoints for two states of a formation differ by more than a step.

    If smaller differences counted, the text would change with every estimate.
    """
    return any(
        abs(round(each.in_unit(first - second), 2)) > each.step
        for each, first, second in zip(ranges, value, other, strict=True)
        if each.name in PREFILLED
    )


def _lines(text: str) -> list[tuple[int, str]]:
    """Return the lines with their numbers, except comments and blank lines."""
    numbered = enumerate(text.splitlines(), start=1)
    return [(number, line.strip()) for number, line in numbered if line.strip() and not line.lstrip().startswith("#")]


def _number(text: str, label: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{label} is {text.strip()[:40]!r}; must be a number") from None
