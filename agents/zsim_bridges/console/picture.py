"""What pages draw of a run, as arrays: poses, ellipsoids, formations, and previews of their flight. No I/O.

Axes of W: east, north, up. Quaternions: w first, body to world.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations, takewhile
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.flight_messages import EstimateView, ViewCluster, ViewDrones
from zsim.math import frames
from zsim.presentation import drone_colours
from zsim.scenario.scenario import Scenario
from zsim.scenario.surroundings import outline_of
from zsim.vehicles.vehicle import ROTORS_MAX
from zsim_agents.formation.flight_plan import REFUSALS, Follow, MoveTo, read_request
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, SingularClusterError
from zsim_agents.references.flight import FlightError, flight_of

Array = NDArray[np.float64]

ROTOR_SLOWDOWN = 50.0  # the fastest rotors turn by 57 degrees per picture at 10 Hz, so none seems to turn backwards
SIGMAS = 2.0  # half axes of an ellipsoid, in standard deviations
SHARE_WITHIN = 1 - math.erfc(SIGMAS / math.sqrt(2)) - math.sqrt(2 / math.pi) * SIGMAS * math.exp(-(SIGMAS**2) / 2)
"""Share of a 3-D Gaussian within 2 sigma: the chi-squared distribution with three degrees of freedom at 4, 0.739."""
RADIUS_MAX_M = 60.0  # maximum half axis of an ellipsoid, which would otherwise enclose the viewer before the first fix
PATH_POINTS = 120  # number of points of one leg of a drone's reference: smooth at the size of a page
SHAPED_PHASES = frozenset({"assembling", "engaged", "held"})  # phases in which a formation has a desired shape
CORNER_SHARE = 0.25  # position of an angle's label between its corner (0) and the opposite side (1), clear of names
CLICK_RAD = 0.012  # minimum half angle within which a click hits a drone; design choice: about five pixels
FULL_NAMES_MAX = 12  # maximum number of drones whose names are shown in full and at full size
PLAN_DIGITS = 2  # decimals of metres: finer than a pixel
HEADING_DIGITS = 3  # decimals of radians
SIDES = {"p": (0, 1), "q": (0, 2)}  # robots at the ends of each side; docs/conventions.md


class DronePoses(NamedTuple):
    """The N drones of a run, in the run's order, at one time."""

    t_ns: int
    names: tuple[str, ...]
    p_W: Array  # (N, 3) m; NaN for a drone that is not in the view
    q_WB: Array  # (N, 4)
    rotor: Array  # (N, ROTORS_MAX) rad/s; 0 beyond a drone's last rotor
    wind_W: Array  # (3,) m/s, the mean over the drones

    @property
    def present(self) -> NDArray[np.bool_]:
        """Whether each drone is in the view, (N,)."""
        return np.isfinite(self.p_W[:, 0])


class Ellipsoids(NamedTuple):
    """Ellipsoids: centres, attitudes and half axes."""

    p_W: Array  # (M, 3) m
    wxyz: Array  # (M, 4)
    half_m: Array  # (M, 3)


class FormationSide(NamedTuple):
    """A side of a formation's triangle, or the only side of a pair."""

    name: str
    ends_W: Array  # (2, 3) m


class FormationShape(NamedTuple):
    """A formation's true shape."""

    c: Array  # (4n,), its variables
    p_c: Array  # (3,) m, origin of its frame in W
    q_WC: Array  # (4,)
    sides: tuple[FormationSide, ...]
    corner: tuple[Array, str] | None  # position [m; W] and text of the label of beta


def drone_poses(view: ViewDrones, names: Sequence[str]) -> DronePoses:
    """Return a view as arrays over the named drones; the view of a replay may lack some of them."""
    count = len(names)
    p_W, q_WB = np.full((count, 3), np.nan), np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
    rotor = np.zeros((count, ROTORS_MAX))
    indices = {name: i for i, name in enumerate(names)}
    for drone in view.drones:
        i = indices.get(drone.name)
        if i is not None:
            p_W[i], q_WB[i] = drone.position_m, drone.orientation_wxyz
            rotor[i, : len(drone.rotor_rad_s)] = drone.rotor_rad_s
    wind = np.mean(view.wind_m_s, axis=0) if view.wind_m_s else np.zeros(3)
    return DronePoses(view.t_ns, tuple(names), p_W, q_WB, rotor, wind)


def radio_lines(hears: Sequence[Sequence[int]], drones: DronePoses) -> tuple[Array, Array]:
    """Return the ends (n, 2, 3) [m] of links between drones in the view: of bidirectional, then of one-way ones.

    `hears` has, for each drone, the indices of the drones that it hears.
    """
    present = drones.present
    pairs = [(i, j) for i, senders in enumerate(hears) for j in senders if max(i, j) < len(present)]
    links = {(i, j) for i, j in pairs if present[i] and present[j]}
    bidirectional = sorted((i, j) for i, j in links if i < j and (j, i) in links)
    one_way = sorted((i, j) for i, j in links if (j, i) not in links)
    ends = [drones.p_W[np.array(each, dtype=int).reshape(-1, 2)] for each in (bidirectional, one_way)]
    return ends[0], ends[1]


def drone_on_ray(
    drones: DronePoses, radii_m: Array, origin_W: Sequence[float], direction_W: Sequence[float]
) -> str | None:
    """Return the drone hit by a ray; of several, the one whose centre is nearest to the ray; None if it hits none.

    Args:
        drones: N drones.
        radii_m: (N,) m, radii of the spheres that a ray must hit; a distant sphere is enlarged to subtend CLICK_RAD.
        origin_W, direction_W: origin and direction of the ray [m; W]; a zero direction hits nothing.
    """
    direction = np.array(direction_W)
    length = float(np.linalg.norm(direction))
    if not 0.0 < length < math.inf:
        return None
    offsets = drones.p_W - np.array(origin_W)
    along_m = offsets @ (direction / length)
    distances_m = np.linalg.norm(offsets - along_m[:, None] * (direction / length), axis=1)
    hit = (along_m > 0.0) & (distances_m <= np.maximum(radii_m, CLICK_RAD * along_m))
    return drones.names[int(np.argmin(np.where(hit, distances_m, math.inf)))] if hit.any() else None


def shown_names(names: Sequence[str]) -> list[str]:
    """Return names; if more than FULL_NAMES_MAX, without the common prefix before a digit, unless that empties one."""
    if len(names) <= FULL_NAMES_MAX:
        return list(names)
    common = takewhile(lambda column: len(set(column)) == 1 and not column[0].isdigit(), zip(*names, strict=False))
    prefix_length = len(list(common))
    suffixes = [name[prefix_length:] for name in names]
    return suffixes if all(suffixes) else list(names)


def rotor_angles(angles: Array, speeds: Array, directions: Array, dt_s: float) -> Array:
    """Return the angles [rad] at which rotors are drawn `dt_s` later, slowed down so that their turning is visible.

    Args:
        angles, speeds: (M,) rad, rad/s.
        directions: (M,), 1 for a rotor that turns clockwise seen from above, otherwise -1.
    """
    return (angles - directions * speeds * (dt_s / ROTOR_SLOWDOWN)) % math.tau


def rotor_poses(p_W: Array, q_WB: Array, hubs_B: Array, angles: Array) -> tuple[Array, Array]:
    """Return centres (M, 3) [m] and quaternions (M, 4) of M rotors.

    Args:
        p_W, q_WB: pose of each rotor's drone, (M, 3) m and (M, 4).
        hubs_B: centres of the rotors, (M, 3) m.
        angles: angles of the rotors, (M,) rad.
    """
    p = p_W + np.einsum("mij,mj->mi", frames.rotation_matrix(q_WB), hubs_B)
    w, x, y, z = q_WB.T
    c, s = np.cos(angles / 2), np.sin(angles / 2)
    return p, np.column_stack((w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s))


def ellipsoids(estimates: Sequence[EstimateView]) -> Ellipsoids:
    """Return the 2-sigma ellipsoids of position estimates."""
    p = np.array([estimate.position_m for estimate in estimates]).reshape(-1, 3)
    P = np.array([estimate.covariance_m2 for estimate in estimates]).reshape(-1, 6)
    sigma_m, q = frames.principal_axes(P[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]])
    return Ellipsoids(p, q, np.clip(SIGMAS * sigma_m, 0.01, RADIUS_MAX_M))


def reference_lines(scenario: Scenario) -> Array:
    """Return the references of single drones in the scenario as segments (M, 2, 3) [m; W]."""
    lines = [np.zeros((0, 2, 3))]
    for drone in scenario.piloted():
        try:
            legs = flight_of(scenario, drone).legs
        except FlightError:
            continue  # the flight is impossible as stated, so there is no line
        for leg in legs:
            length_s = leg.path.duration_s
            end_s = scenario.duration_s - leg.start_s if length_s is None else length_s
            times = np.linspace(0.0, max(end_s, 0.0), PATH_POINTS).tolist()
            p_W = np.array([leg.path.value(t_s)[0][:3] for t_s in times])
            lines.append(np.stack((p_W[:-1], p_W[1:]), axis=1))
    return np.concatenate(lines)


def ghosts(space: ClusterSpace, view: ViewCluster) -> tuple[Array, Array] | None:
    """Return the desired positions (n, 3) [m] and quaternions (n, 4) of a formation's robots; None without a shape."""
    if view.phase not in SHAPED_PHASES:
        return None
    try:
        p_W, yaw = space.inverse(np.array(view.desired))
    except SingularClusterError:
        return None
    return p_W, frames.quaternion_from_heading(yaw)


def formation_shape(space: ClusterSpace, p_W: Array, yaw: Array) -> FormationShape | None:
    """Return the shape of robots at `p_W` (n, 3) [m] with headings `yaw` (n,) [rad]; None if it is singular."""
    try:
        c = space.forward(p_W, yaw)
    except SingularClusterError:
        return None
    roll, pitch, turn = (c[space.index(name)] if name in space.names else 0.0 for name in ("roll", "pitch", "yaw"))
    has_groups = any("." in name for name in space.names)  # if so, p and q are distances between groups, not robots
    side_names = [name for name in SIDES if name in space.names and not has_groups]
    sides = [FormationSide(f"{name} {c[space.index(name)]:.2f} m", p_W[list(SIDES[name])]) for name in side_names]
    corner = None
    if "beta" in space.names and len(side_names) == 2:
        sides.append(FormationSide("", p_W[[1, 2]]))
        corner = (
            p_W[0] + CORNER_SHARE * (p_W[1:].mean(axis=0) - p_W[0]),
            f"β {math.degrees(c[space.index('beta')]):.1f}°",
        )
    return FormationShape(c, c[:3], frames.quaternion_from_rpy((roll, pitch, turn)), tuple(sides), corner)


# The plan view, from above


def surroundings(scenario: Scenario) -> dict[str, Any]:
    """Return the constant part of the plan: names, labels and colours of drones; outlines of obstacles and surfaces."""
    names = [drone.name for drone in scenario.drones]
    return {
        "names": names,
        "labels": shown_names(names),
        "colours": list(drone_colours(len(names))),
        "obstacles": [
            {
                "name": each.name,
                "x_m": each.position_m[0],
                "y_m": each.position_m[1],
                "yaw_deg": each.yaw_deg,
                "radius_m": each.radius_m,  # radius of a disc; None for a box
                "size_m": list(each.size_m[:2]) if each.size_m is not None else None,
            }
            for each in scenario.environment.obstacles
        ],
        "surfaces": [
            {"name": each.name, "outline_m": outline_of(each)} for each in scenario.environment.surfaces or ()
        ],
    }


def plan_positions(drones: DronePoses, states: Mapping[str, str]) -> list[list[Any] | None]:
    """Return x, y, z [m; W], heading [rad] and state of each drone; None for one that is not in the view."""
    yaw = frames.heading(drones.q_WB)
    return [
        [*np.round(p_W, PLAN_DIGITS).tolist(), round(float(yaw[i]), HEADING_DIGITS), states.get(drones.names[i], "")]
        if drones.present[i]
        else None
        for i, p_W in enumerate(drones.p_W)
    ]


def plan_formations(
    spaces: Mapping[str, ClusterSpace], members: Mapping[str, list[int]], views: Mapping[str, ViewCluster]
) -> list[dict[str, Any]]:
    """Return the phase, the indices of drones, and the desired positions (x, y) [m; W] of each formation."""
    shown = []
    for name, view in views.items():
        desired = ghosts(spaces[name], view)
        positions = [] if desired is None else np.round(desired[0][:, :2], PLAN_DIGITS).tolist()
        shown.append({"name": name, "phase": view.phase, "drones": members[name], "places": positions})
    return shown


# What a formation would fly

PREVIEW_POINTS = 121  # number of points of a path; design choice: a curve in 3-D looks smooth
TRANSIT_SHARE = 0.25  # number of points of the transit to a trajectory's start, as a share of PREVIEW_POINTS
ENDLESS_S = 120.0  # simulated; how much of an endless trajectory is shown


class PreviewError(ValueError):
    """A request cannot be flown from the formation's present state."""


class FlightPreview(NamedTuple):
    """The paths of n drones.

    Attributes:
        paths_W: (n, M, 3) m, from the present desired positions on.
        text: length, heights, speed and distances of the paths, for operators.
    """

    paths_W: Array
    text: str


def preview_of(
    space: ClusterSpace, op: str, args: Mapping[str, Any], base: Array, separation_min_m: float
) -> FlightPreview:
    """Return the paths of a `target` or `trajectory`; the controller may still refuse it, or fly it more slowly.

    Args:
        op, args: operation and arguments of the request, as sent.
        base: present desired variables of the formation, (4n,).
        separation_min_m: minimum distance between two drones that the controller permits.

    Raises:
        PreviewError: the request is invalid, or no formation of this space can fly it.
    """
    transit, span_s, length = np.zeros((0, space.size)), 0.0, ""
    try:
        request = read_request(op, args)
        if isinstance(request, MoveTo):
            path = _ramp(space, base, request.goal(space, base), PREVIEW_POINTS)
        else:
            assert isinstance(request, Follow)
            reference = request.trajectory(space, base)
            span_s = reference.duration_s or ENDLESS_S
            length = f"{span_s:g} s{'' if reference.duration_s else ' shown'}"
            path = np.array([reference.value(t_s)[0] for t_s in np.linspace(0.0, span_s, PREVIEW_POINTS)])
            transit = _ramp(space, base, path[0], round(PREVIEW_POINTS * TRANSIT_SHARE))
        paths_W = np.array([space.inverse(c)[0] for c in (*transit, *path)]).transpose(1, 0, 2)
    except REFUSALS as error:
        raise PreviewError(str(error)) from None
    path_W = paths_W[:, len(transit) :]
    steps_m, heights_m = np.linalg.norm(np.diff(path_W, axis=1), axis=2), path_W[:, :, 2]
    texts = [
        length or f"{steps_m.sum(axis=1).max():.1f} m at most",
        f"heights {heights_m.min():.1f} to {heights_m.max():.1f} m",
    ]
    if span_s:
        texts.append(f"{steps_m.max() * (PREVIEW_POINTS - 1) / span_s:.1f} m/s at most")
    pairs = combinations(path_W, 2)
    separation_m = min((float(np.linalg.norm(a - b, axis=1).min()) for a, b in pairs), default=math.inf)
    too_near = (
        f", less than the {separation_min_m:g} m that the controller requires"
        if separation_m < separation_min_m
        else ""
    )
    return FlightPreview(paths_W, "; ".join([*texts, f"drones {separation_m:.1f} m apart or more{too_near}"]))


def _ramp(space: ClusterSpace, start: Array, goal: Array, count: int) -> Array:
    """Return a straight line in cluster space, (count, 4n); angles take the shorter direction."""
    return start + np.linspace(0.0, 1.0, count)[:, None] * space.difference(goal, start)
