"""The flights of drones with their own references: take-off, approach to a path, and the path.

A flight is checked in advance: its speeds, yaw rates and horizontal accelerations against the drone's limits, its
heights, and its distances to other flights and to formations. When a formation engages, and how it approaches its
target or trajectory, depend on its estimates; distances to it are therefore checked only from the time by which it must
have arrived there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.flight_messages import ReferencePhase
from zsim.errors import DocumentError, NotTrustedError, RunError, UserCodeError
from zsim.math import elementary as el
from zsim.scenario.scenario import STAGES_MAX, Drone, DroneReference, Exchange, PathPoint, Piloted, Scenario
from zsim.vehicles.vehicle import vehicle_of
from zsim_agents.formation.assembly import assign
from zsim_agents.formation.expression import ExpressionError
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.trajectory import ExpressionTrajectory, Reference, TrajectoryError, WaypointTrajectory
from zsim_agents.references.path import (
    SHARE,
    EndMotion,
    Laps,
    PathLimits,
    Peaks,
    PiecewisePolynomial,
    Scaled,
    circle,
    figure_eight,
    minimum_snap,
    move,
    peaks_of,
    round_up,
)

if TYPE_CHECKING:
    from zsim_agents.formation.engagement_setup import PlannedMotion

READY_S = 4.0  # minimum time from the take-off command to the first path; an AR.Drone takes at least 4 s to take off
APPROACH_SHARE = 0.5  # usable share of the limits on an approach, which need not be fast, to a path that starts at rest
ROUNDING = 1.0 + 1e-9  # tolerance for durations that just satisfy the limits
HEIGHT_MIN_M = 0.2  # minimum height of a path: above most of the ground effect of the smallest drones
SAMPLES_MAX, SAMPLE_S = 4001, 0.05  # sampling of a path's heights
TOLERANCE_M = 1e-3  # tolerance of the minimum distance between two paths
STEP_S = 0.05  # interval at which the distances between all paths are checked
STEP_MIN_S = 1e-4  # minimum length of an interval that is still halved
DELAY_MAX_S = 15.0  # of a formation: take-off takes up to 12 s (3 s are planned), and engagement awaits estimates
COARSE_STEP_S, FINE_STEP_S = 0.1, 0.01  # interval of checks of distances to a formation: normally, and at close range
APPROACH_MAX_M = 0.5  # maximum decrease within COARSE_STEP_S of the distance between a drone and a robot of a formation
VARIABLE_NAMES = ("x", "y", "z", "yaw")
QUANTITIES = (
    ("horizontal speed", "m/s"),
    ("climb", "m/s"),
    ("yaw rate", "rad/s"),
    ("horizontal acceleration", "m/s^2"),
)


class FlightError(ValueError):
    """A flight is impossible.

    The message consists of `path`, the field within the reference or exchange, and `text`, what is wrong with it.
    """

    def __init__(self, path: str, text: str) -> None:
        super().__init__(f"{path} {text}".strip())
        self.path, self.text = path, text


class PoseVariables:
    """The position and heading of one drone as variables, with the interface of a cluster space."""

    names = VARIABLE_NAMES
    in_radians = np.array([False, False, False, True])

    def index(self, name: str) -> int:
        if name not in self.names:
            raise ValueError(f"{name[:40]!r} is unknown; allowed: {', '.join(self.names)}, yaw_deg")
        return self.names.index(name)

    def difference(self, c_to: Array, c_from: Array) -> Array:
        change = c_to - c_from
        change[3] = math.remainder(change[3], math.tau)
        return change


class Leg(NamedTuple):
    """A part of a flight: a path that starts at the simulated time `start_s`."""

    start_s: float
    path: Reference
    phase: ReferencePhase


@dataclass(frozen=True, eq=False)
class Flight:
    """The `Reference` of a drone over simulated time [s].

    Before the first leg the drone stays at `hover` (4,), where its take-off ends; after a leg it stays at the leg's end
    until the next one starts.
    """

    hover: Array
    legs: tuple[Leg, ...] = ()

    @property
    def duration_s(self) -> float | None:
        if not self.legs:
            return 0.0
        last = self.legs[-1].path.duration_s
        return None if last is None else self.legs[-1].start_s + last

    def leg_at(self, t_s: float) -> Leg | None:
        return next((leg for leg in reversed(self.legs) if leg.start_s <= t_s), None)

    def value(self, t_s: float) -> tuple[Array, Array]:
        leg = self.leg_at(t_s)
        return (self.hover, np.zeros(4)) if leg is None else leg.path.value(t_s - leg.start_s)

    def phase(self, t_s: float) -> tuple[ReferencePhase, float | None]:
        """Return the phase and, in the phase "path", the time since the start of the path [s]."""
        leg = self.leg_at(t_s)
        if leg is None:
            return "holding", None
        local_s, end_s = t_s - leg.start_s, leg.path.duration_s
        if end_s is not None and local_s > end_s:
            return "holding", None
        return leg.phase, local_s if leg.phase == "path" else None

    def peaks(self) -> Peaks:
        """Return the peaks over all legs; their times are not determined and set to 0."""
        leg_peaks = [peaks_of(leg.path) for leg in self.legs]
        speed, climb, turn, accel = np.max([[0.0] * 4, *(peaks[:4] for peaks in leg_peaks)], axis=0).tolist()
        return Peaks(speed, climb, turn, accel, at_s=(0.0, 0.0, 0.0, 0.0))


def limits_of(drone: Drone, gravity_m_s2: float) -> PathLimits:
    """Return the path limits of a drone: its firmware's limits, with the tilt converted to an acceleration."""
    limits = drone.limits
    accel = gravity_m_s2 * el.tan(math.radians(limits.tilt_deg))
    return PathLimits(
        limits.horizontal_speed_m_s, limits.vertical_speed_m_s, math.radians(limits.yaw_rate_deg_s), accel
    )


def hover_of(drone: Drone) -> Array:
    """Return the position [m; W] and yaw [rad] at which a drone hovers after its take-off, (4,)."""
    x, y, z = drone.position_m
    return np.array([x, y, z + drone.takeoff_height_m, math.radians(drone.yaw_deg)])


def flight_of(scenario: Scenario, drone: str) -> Flight:
    """Return the flight of a drone that has a reference or takes part in an exchange.

    Raises:
        FlightError: the flight is impossible.
    """
    settings = scenario.piloted()[drone]
    if isinstance(settings, Exchange):
        return exchange_flights(scenario, settings)[drone]
    spec = scenario.drone(drone)
    limits, hover = limits_of(spec, scenario.environment.gravity_m_s2), hover_of(spec)
    if settings.start_s is None:
        return Flight(hover)
    path = fitted_path(settings, limits, hover[3], spec.limits.altitude_m)
    approach = approach_to(hover, path, limits)
    from_s, earliest_s = settings.start_s - (approach.duration_s or 0.0), settings.takeoff_s + READY_S
    if from_s < earliest_s:
        needed = (
            f"must be >= {earliest_s + (approach.duration_s or 0.0):.2f}: "
            f"the drone takes off at {settings.takeoff_s:g} s and climbs, and then the"
        )
        raise FlightError("start_s", f"is {settings.start_s:g}; {needed} approach takes {approach.duration_s:.2f} s")
    return Flight(hover, (Leg(from_s, approach, "approaching"), Leg(settings.start_s, path, "path")))


def approach_to(
    start: Array, path: Reference, limits: PathLimits, begin: EndMotion | None = None
) -> PiecewisePolynomial:
    """Return the approach from a position and yaw (4,) to the start of a path.

    Raises:
        FlightError: no path within the limits exists, usually because the path to be joined starts too fast.
    """
    position, rate = path.value(0.0)
    end = EndMotion(rate, np.zeros(4), np.zeros(4)) if rate.any() else None
    usable = limits.share(SHARE if rate.any() else APPROACH_SHARE)
    try:
        return move(start, position, usable, begin=begin, end=end)
    except TrajectoryError as error:
        raise FlightError("", str(error)) from None


def fitted_path(spec: DroneReference, limits: PathLimits, yaw: float, altitude_max_m: float) -> Reference:
    """Return the path of a reference at its own speed or, if `fit` is set, slowed to satisfy the limits.

    Raises:
        FlightError: the path is invalid, too fast, too low or too high; the error names the field.
    """
    (kind,) = spec.paths()
    try:
        unscaled = _paths_of(spec, yaw)[kind]()
        origin = np.array([*spec.origin_m, 0.0])
        path = Scaled(unscaled, spec.time_scale, origin)
        factor = peaks_of(path).factor(limits.share(SHARE))
        if factor > ROUNDING:
            if not spec.fit:
                raise FlightError("", _too_fast(path.peaks(), limits, factor, f"time_scale {spec.time_scale:g}"))
            path = replace(path, factor=spec.time_scale * round_up(factor))
        _check_heights(path, altitude_max_m)
    except TrajectoryError as error:
        raise FlightError(f"{kind}", str(error)) from None
    except ExpressionError as error:
        raise FlightError(f"expressions.{error.name}" if error.name else "expressions", error.finding) from None
    return path


def _paths_of(spec: DroneReference, yaw: float) -> Mapping[str, Callable[[], Reference]]:
    """Return a constructor for each kind of path; `yaw` is the default heading [rad]."""
    base = np.array([0.0, 0.0, 0.0, yaw])

    def expressions() -> Reference:
        return ExpressionTrajectory(PoseVariables(), spec.expressions, base, spec.constants, spec.duration_s)

    def laps(curve: Any, settings: Any) -> Reference:
        return Laps(lambda angle: _with_yaw(curve(angle), yaw), settings.period_s, settings.laps)

    round_, eight = spec.circle, spec.figure_eight
    return {
        "waypoints": lambda: WaypointTrajectory(PoseVariables(), _named(spec.waypoints), base),
        "minimum_snap": lambda: _minimum_snap_path(spec.minimum_snap, yaw),
        "expressions": expressions,
        "pieces": lambda: _polynomials(spec),
        "circle": lambda: laps(circle(round_.radius_m, round_.climb_m), round_) if round_ else Flight(base),
        "figure_eight": lambda: laps(figure_eight(eight.length_m, eight.width_m), eight) if eight else Flight(base),
    }


def _with_yaw(point: tuple[Array, Array], yaw: float) -> tuple[Array, Array]:
    point[0][3] = yaw
    return point


def _named(points: Sequence[PathPoint]) -> list[dict[str, Any]]:
    """Return points in the form that `WaypointTrajectory` takes."""
    named = []
    for point in points:
        values: dict[str, float] = dict(zip(VARIABLE_NAMES, point.position_m, strict=False))
        if point.yaw_deg is not None:
            values["yaw_deg"] = point.yaw_deg
        named.append({"at_s": point.at_s, "values": values})
    return named


def _minimum_snap_path(points: Sequence[PathPoint], yaw: float) -> Reference:
    """Return the minimum-snap path through points, at rest until the time of the first one, turning the shorter way.

    `yaw` is the heading at points before the first one that states its own [rad].
    """
    positions = np.empty((len(points), 4))
    for row, point in zip(positions, points, strict=True):
        desired_yaw = yaw if point.yaw_deg is None else math.radians(point.yaw_deg)
        yaw += math.remainder(desired_yaw - yaw, math.tau)
        row[:] = *point.position_m, yaw
    times = [point.at_s for point in points]
    if len(times) < 2:
        raise TrajectoryError("has 1 entry; must have 2 or more")
    for number, (before_s, after_s) in enumerate(pairwise(times), start=1):
        if after_s <= before_s:
            raise TrajectoryError(f"[{number}].at_s is {after_s:g}; must be > {before_s:g}, the one before")
    path = minimum_snap([t - times[0] for t in times], positions)
    if not times[0]:
        return path
    rest = np.zeros((1, *path.coefficients.shape[1:]))
    rest[0, 0] = positions[0]
    durations = np.concatenate(([times[0]], path.durations_s))
    return PiecewisePolynomial(durations, np.concatenate((rest, path.coefficients)))


def _polynomials(spec: DroneReference) -> Reference:
    coefficients = np.zeros((len(spec.pieces), 8, 4))
    for piece_coefficients, piece in zip(coefficients, spec.pieces, strict=True):
        for k, terms in enumerate((piece.x, piece.y, piece.z, piece.yaw)):
            piece_coefficients[: len(terms), k] = terms
    return PiecewisePolynomial(np.array([piece.duration_s for piece in spec.pieces]), coefficients)


def _too_fast(peaks: Peaks, limits: PathLimits, factor: float, scale_text: str) -> str:
    """Return the error text on the quantity that exceeds its limit most; `scale_text` states the current time scale."""
    shares = [peak / limit for peak, limit in zip(peaks[:4], limits, strict=True)]
    weighted = [*shares[:3], math.sqrt(shares[3] * SHARE)]  # weighted as in `Peaks.factor`
    worst = int(np.argmax(weighted))
    quantity, unit = QUANTITIES[worst]
    found = f"needs a {quantity} of {peaks[worst]:.3g} {unit} at {peaks.at_s[worst]:.2f} s"
    allowed = f"must be at most {SHARE * limits[worst]:.3g}, {SHARE:g} of the drone's limit"
    return f"{found}; {allowed}: slow it down by a factor of {round_up(factor):g} ({scale_text}), or set fit: true"


def _check_heights(path: Reference, altitude_max_m: float) -> None:
    end_s = path.duration_s
    end_s = 600.0 if end_s is None else end_s
    times = np.linspace(0.0, end_s, min(max(math.ceil(end_s / SAMPLE_S) + 1, 2), SAMPLES_MAX)).tolist()
    heights = [float(path.value(t)[0][2]) for t in times]
    lowest = int(np.argmin(heights))
    if heights[lowest] < HEIGHT_MIN_M:
        found = f"leads to z = {heights[lowest]:.2f} m at {times[lowest]:.2f} s"
        raise FlightError("", f"{found}; must be >= {HEIGHT_MIN_M:g} m: raise origin_m[2]")
    highest = int(np.argmax(heights))
    if heights[highest] > altitude_max_m:
        found = f"leads to z = {heights[highest]:.2f} m at {times[highest]:.2f} s"
        raise FlightError("", f"{found}; must be <= {altitude_max_m:g} m, its limits.altitude_m")


def exchange_flights(scenario: Scenario, exchange: Exchange) -> dict[str, Flight]:
    """Return the flights of an exchange, by drone.

    In each stage, the drones are assigned to the goals and fly there in straight lines, starting and ending together.

    Raises:
        FlightError: a stage is too fast, too low, or starts too early.
    """
    specs = [scenario.drone(name) for name in exchange.drones]
    gravity = scenario.environment.gravity_m_s2
    limits = np.array([limits_of(spec, gravity).share(SHARE) for spec in specs])  # columns as in PathLimits
    positions = np.array([hover_of(spec) for spec in specs])
    hovers, stages = positions.copy(), list[tuple[float, float, Array]]()
    unit = minimum_snap((0.0, 1.0), np.array([[0.0] * 4, [1.0, 0.0, 0.0, 0.0]]))
    rise, peaks = unit.coefficients[0, :, 0], unit.peaks()
    ready_s = exchange.takeoff_s + READY_S
    for number, stage in enumerate(exchange.stages):
        path = f"stages[{number}]"
        if stage.start_s < ready_s:
            raise FlightError(f"{path}.start_s", f"is {stage.start_s:g}; must be >= {ready_s:.2f}, when all are ready")
        for index, (_, _, z) in enumerate(stage.places_m):
            if z < HEIGHT_MIN_M:
                raise FlightError(f"{path}.places_m[{index}][2]", f"is {z:g}; must be >= {HEIGHT_MIN_M:g}")
        goals = positions.copy()
        goals[:, :3] = np.array(stage.places_m)[_assigned(positions[:, :3].tobytes(), tuple(stage.places_m))]
        deltas = goals - positions
        horizontal_m, vertical_m = np.sqrt(np.square(deltas[:, :2]).sum(axis=1)), np.abs(deltas[:, 2])
        speeds = peaks.speed_m_s * np.maximum(horizontal_m / limits[:, 0], vertical_m / limits[:, 1])
        min_s = float(np.maximum(speeds, np.sqrt(peaks.accel_m_s2 * horizontal_m / limits[:, 3])).max())
        over_s = stage.over_s
        if min_s > over_s * ROUNDING:
            if not exchange.fit:
                needed = f"must be >= {round_up(min_s):g} for the longest distance, or set fit: true"
                raise FlightError(f"{path}.over_s", f"is {over_s:g}; {needed}")
            over_s = round_up(min_s)
        coefficients = (rise / [el.power(over_s, float(k)) for k in range(len(rise))])[:, None] * deltas[:, None, :]
        coefficients[:, 0] += positions
        stages.append((stage.start_s, over_s, coefficients))
        positions, ready_s = goals, stage.start_s + over_s

    def legs(k: int) -> Iterator[Leg]:
        for start_s, over_s, coefficients in stages:
            yield Leg(start_s, PiecewisePolynomial(np.array([over_s]), coefficients[k : k + 1]), "path")

    return {name: Flight(hovers[k], tuple(legs(k))) for k, name in enumerate(exchange.drones)}


@lru_cache(maxsize=STAGES_MAX)  # the pilot of each drone requests the same assignments
def _assigned(starts_m: bytes, goals_m: tuple[tuple[float, float, float], ...]) -> NDArray[np.intp]:
    return assign(np.frombuffer(starts_m).reshape(-1, 3), np.array(goals_m))


def land_s_of(settings: Piloted) -> float:
    return math.inf if settings.land_s is None else settings.land_s


# All flights of a scenario


def flight_faults(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Yield the field's path and the text of each fault of a reference, then of distances that are too small.

    Distances are checked between flights, and to formations from the time by which these must follow their plan.
    """
    flights: dict[str, Flight] = {}
    exchanges = [] if not isinstance(scenario.exchanges, list) else scenario.exchanges
    is_valid = True
    for index, exchange in enumerate(exchanges):
        try:
            flights |= exchange_flights(scenario, exchange)
        except FlightError as fault:
            is_valid = False
            yield f"exchanges[{index}]{'.' * bool(fault.path)}{fault.path}", fault.text
    for index, drone in enumerate(scenario.drones):
        if isinstance(drone.reference, DroneReference):
            try:
                flights[drone.name] = flight_of(scenario, drone.name)
            except FlightError as fault:
                is_valid = False
                path = f"drones[{index}].reference{'.' * bool(fault.path)}{fault.path}"
                yield path, f"{fault.text} (drone {drone.name!r})"
    if is_valid and (text := separation_fault(scenario, flights)):
        yield "drones", text
    if is_valid and scenario.clusters:
        yield from _formation_faults(
            scenario, flights, {name: land_s_of(each) for name, each in scenario.piloted().items()}
        )


def separation_fault(scenario: Scenario, flights: Mapping[str, Flight]) -> str | None:
    """Return a text about the first two drones whose flights come too close, or None."""
    names = [*flights]
    try:
        clearance = np.array([_clearance_m(scenario, name) for name in names])
    except (NotTrustedError, DocumentError):
        return None  # the clearance of a user's vehicle is unknown, since its file is not loaded here
    ends = [flight.duration_s for flight in flights.values()]
    until_s = min(max((scenario.duration_s if end is None else end for end in ends), default=0.0), scenario.duration_s)
    if len(names) < 2 or until_s <= 0.0:
        return None
    found = first_approach([*flights.values()], clearance, until_s)
    if found is None:
        return None
    pair = f"{names[found.first]} and {names[found.second]}"
    separation_min_m = float(clearance[found.first] + clearance[found.second])
    finding = f"{pair} are {found.distance_m:.2f} m apart at {found.t_s:.2f} s"
    return f"have references on which {finding}; must be >= {separation_min_m:g} m"


def checked_flight(scenario: Scenario, drone: str) -> Flight:
    """Return the flight of a drone after checking it.

    For the first drone that has a flight, all flights of the scenario are checked.

    Raises:
        RunError: a flight is impossible, or comes too close to another or to a formation.
    """
    try:
        flight = flight_of(scenario, drone)
    except FlightError as fault:
        raise RunError(f"reference of {drone}: {fault}") from fault
    if drone == next(iter(scenario.piloted())):
        first_fault = next(flight_faults(scenario), None)
        if first_fault is not None:
            raise RunError(f"{first_fault[0]} {first_fault[1]}")
    return flight


class Approach(NamedTuple):
    """Two paths that come too close: their indices, the distance between them [m], and the time [s]."""

    first: int
    second: int
    distance_m: float
    t_s: float


def first_approach(paths: Sequence[Reference], clearances_m: Array, until_s: float) -> Approach | None:
    """Return the earliest approach of two paths closer than allowed, to within a millimetre; None if there is none.

    Within an interval, the distance between two paths is at least the mean of its values at both ends minus half the
    interval's length times the sum of the peak speeds; where this bound is too small, the interval is halved.

    Args:
        clearances_m: clearance of each drone [m], (n,); the minimum distance of a pair is the sum of both clearances.
        until_s: end of the search.
    """
    from scipy.spatial import KDTree

    if len(paths) < 2:
        return None
    peaks = [peaks_of(path) for path in paths]
    speed = np.array([el.hypot(each.speed_m_s, each.climb_m_s) for each in peaks])
    steps = max(2, math.ceil(until_s / STEP_S) + 1)
    times = np.linspace(0.0, until_s, steps).tolist()
    positions = np.array([[path.value(t)[0][:3] for path in paths] for t in times])
    step_s = times[1] - times[0]
    reach = 2.0 * float(clearances_m.max() + speed.max() * step_s)
    for k, t in enumerate(times[:-1]):
        for i, j in sorted(KDTree(positions[k]).query_pairs(reach)):
            pair = (paths[i], paths[j], float(speed[i] + speed[j]), float(clearances_m[i] + clearances_m[j]))
            found = _find_approach(*pair, t, times[k + 1])
            if found is not None:
                return Approach(i, j, *found)
    return None


def _find_approach(
    a: Reference, b: Reference, speed: float, separation_min_m: float, from_s: float, to_s: float
) -> tuple[float, float] | None:
    """Return the first distance below `separation_min_m` between `from_s` and `to_s` and its time, or None."""

    def distance_at(t_s: float) -> float:
        return el.distance(a.value(t_s)[0][:3].tolist(), b.value(t_s)[0][:3].tolist())

    intervals = [(from_s, distance_at(from_s), to_s, distance_at(to_s))]
    while intervals:
        low, at_low, high, at_high = intervals.pop()
        for distance, t_s in ((at_low, low), (at_high, high)):
            if distance < separation_min_m - TOLERANCE_M:
                return distance, t_s
        if (at_low + at_high - speed * (high - low)) / 2.0 < separation_min_m - TOLERANCE_M and high - low > STEP_MIN_S:
            middle = (low + high) / 2.0
            at_middle = distance_at(middle)
            intervals += [(middle, at_middle, high, at_high), (low, at_low, middle, at_middle)]
    return None


def _formation_faults(
    scenario: Scenario, flights: Mapping[str, Reference], until_s: Mapping[str, float]
) -> Iterator[tuple[str, str]]:
    """Yield, for each formation that comes too close to a drone with a reference, the field's path and a text.

    Args:
        flights: flights by drone.
        until_s: landing times by drone.
    """
    from zsim_agents.formation.engagement_setup import planned_motion  # here, since few scenarios have both

    for index, cluster in enumerate(scenario.clusters if flights else ()):
        try:
            planned = planned_motion(scenario, cluster)
            clearance = {name: _clearance_m(scenario, name) for name in (*flights, *cluster.drones)}
        except (NotTrustedError, DocumentError, RunError, UserCodeError):
            continue  # reported by the check of the plan, or caused by user code that is not loaded here
        if planned is None:
            continue
        cluster_clearance_m = max(clearance[name] for name in cluster.drones)
        found = [
            _find_meeting(planned, flights[name], until_s[name], cluster_clearance_m + clearance[name])
            for name in flights
        ]
        meetings = [(each, name) for each, name in zip(found, flights, strict=True) if each is not None]
        if meetings:
            (t_s, distance_m, robot), name = min(meetings)
            finding = f"brings robot {robot + 1} within {distance_m:.2f} m of {name}, on its reference, at {t_s:.1f} s"
            separation_min_m = cluster_clearance_m + clearance[name]
            yield (
                f"clusters[{index}].{planned.path}",
                f"{finding}; must be >= {separation_min_m:g} m (cluster {cluster.name!r})",
            )


def _find_meeting(
    planned: PlannedMotion, flight: Reference, until_s: float, separation_min_m: float
) -> tuple[float, float, int] | None:
    """Return when a drone first comes too close to a robot, their distance, and the robot's index; None if never."""
    from_s, to_s = planned.from_s + DELAY_MAX_S, min(planned.until_s, until_s)
    for t_s in np.arange(from_s, to_s, COARSE_STEP_S).tolist():
        if float(_distances(planned, flight, t_s).min()) >= separation_min_m + APPROACH_MAX_M:
            continue
        for fine_s in np.arange(t_s, min(t_s + COARSE_STEP_S, to_s), FINE_STEP_S).tolist():
            distances = _distances(planned, flight, fine_s)
            robot = int(distances.argmin())
            if distances[robot] < separation_min_m:
                return fine_s, float(distances[robot]), robot
    return None


def _distances(planned: PlannedMotion, flight: Reference, t_s: float) -> Array:
    offsets_W = planned.positions(t_s) - flight.value(t_s)[0][:3]
    return np.sqrt((offsets_W**2).sum(axis=1))


def _clearance_m(scenario: Scenario, drone: str) -> float:
    return vehicle_of(scenario.drone(drone).model).airframe.clearance_m
