"""A formation flight as arrays: desired, estimated and true variables, their errors and statistics."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.errors import NotTrustedError
from zsim.scenario.scenario import Cluster, Scenario
from zsim_agents.formation.expression import ExpressionError
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, SingularClusterError
from zsim_agents.formation.spaces.scenario_space import cluster_space, scenario_space
from zsim_agents.formation.trajectory import TrajectoryError, named_values
from zsim_analysis.reading.recorded_flight import Array, ClusterStates, RecordedFlight, Times, Track

BLOCK = 512  # number of samples whose distances are held in memory at once


class ParameterErrors(Struct, frozen=True):
    """Errors of one cluster parameter against its desired value, in its own unit (m or rad).

    `est` is what the controller saw (estimate − desired), `true` what the drones did (truth − desired), over the same
    samples, if any truth is known. std² + mean² = rms². None: no such samples.
    """

    est_std: float | None
    est_rms: float | None
    est_mean: float | None
    true_std: float | None
    true_rms: float | None
    true_mean: float | None


@dataclass
class Formation:
    """K samples of a cluster of n drones; m or rad, NaN where unknown."""

    name: str
    drones: tuple[str, ...]
    names: tuple[str, ...]
    t_s: Array  # (K,) simulated time
    # desired, value, true: (K, 4n)
    desired: Array
    value: Array
    true: Array
    # est_error, true_error: (K, 4n) value − desired and true − desired, angles wrapped to ±π
    est_error: Array
    true_error: Array
    phases: list[str]  # (K,)

    def column(self, name: str) -> int:
        return self.names.index(name)

    @property
    def engaged_s(self) -> float | None:
        """Time of the first engagement [s]; None if the cluster never engaged."""
        return next((float(t_s) for t_s, phase in zip(self.t_s, self.phases, strict=True) if phase == "engaged"), None)

    @property
    def engaged(self) -> NDArray[np.bool_]:
        return np.array([phase == "engaged" for phase in self.phases], bool)

    @property
    def since_engaged(self) -> NDArray[np.bool_]:
        """Mask (K,) of the samples from the first engagement on; all samples if the cluster never engaged."""
        return self.t_s >= (-np.inf if self.engaged_s is None else self.engaged_s)

    def within(self, window_s: tuple[float, float]) -> NDArray[np.bool_]:
        return (self.t_s >= window_s[0]) & (self.t_s <= window_s[1])

    def judged(self, window_s: tuple[float, float]) -> NDArray[np.bool_]:
        """Return a mask (K,) of a window's engaged samples; in the others, the desired value may be the estimate."""
        return self.within(window_s) & self.engaged

    def engaged_share(self, window_s: tuple[float, float]) -> float | None:
        """Return the share of a window's samples in which the cluster was engaged; None without samples."""
        rows = self.within(window_s)
        return float(self.judged(window_s).sum() / rows.sum()) if rows.any() else None

    def errors(self, window_s: tuple[float, float]) -> dict[str, ParameterErrors]:
        """Return the statistics of every parameter over the engaged part of a window."""
        rows = self.judged(window_s)
        statistics = {}
        for i, name in enumerate(self.names):
            est, true = self.est_error[rows, i], self.true_error[rows, i]
            is_finite = np.isfinite(est) & np.isfinite(true)
            moments: list[float | None] = []
            for error in (est[is_finite] if is_finite.any() else est[np.isfinite(est)], true[is_finite]):
                statistics_of_error = (
                    [float(error.std()), float(np.sqrt(np.mean(error**2))), float(error.mean())] if len(error) else []
                )
                moments += statistics_of_error or [None] * 3
            statistics[name] = ParameterErrors(*moments)
        return statistics


def cluster_of(scenario: Scenario | None, name: str) -> Cluster | None:
    return next((each for each in scenario.clusters if each.name == name), None) if scenario else None


def formations_of(flight: RecordedFlight) -> list[Formation]:
    """Return the clusters of a flight whose variables can be judged."""
    formations = (formation(states, flight.tracks, flight.scenario) for states in flight.clusters)
    return [each for each in formations if each]


def formation(states: ClusterStates, tracks: list[Track], scenario: Scenario | None) -> Formation | None:
    """Return a cluster's formation; None without states or space, or if its variables are not the scenario's."""
    if not len(states.t_ns):
        return None
    cluster = cluster_of(scenario, states.name)
    try:  # for an unknown cluster, the default space for its number of drones
        space = scenario_space(scenario, cluster) if scenario and cluster else cluster_space(len(states.drones))
    except (ValueError, NotTrustedError):
        return None
    if states.names != space.names:
        return None
    # on the wire, all zeros mean unknown
    value, desired = (
        np.where(rows.any(axis=1, keepdims=True), rows, np.nan) for rows in (states.value, states.desired)
    )
    by_name = {track.name: track for track in tracks}
    members = [by_name[name] for name in states.drones if name in by_name]
    true = np.full((len(states.t_ns), space.size), np.nan)
    orders = np.array(states.orders or [" ".join(states.drones)] * len(true))
    for order in dict.fromkeys(orders.tolist()):  # only one, unless drones were reassigned
        rows = np.flatnonzero(orders == order)
        ordered = [by_name[name] for name in order.split() if name in by_name]
        true[rows] = _true(space, ordered if len(ordered) == len(members) else members, states.t_ns[rows])
    est_error, true_error = (
        np.array([space.difference(*pair) for pair in zip(actual, desired, strict=True)]) for actual in (value, true)
    )
    t_s, drones, names = states.t_ns / 1e9, states.drones, states.names
    return Formation(states.name, drones, names, t_s, desired, value, true, est_error, true_error, states.phases)


def _true(space: ClusterSpace, members: list[Track], wanted_ns: Times) -> Array:
    """Return the true cluster variables (K, 4n); NaN without truth, for a singular shape, or if a drone is external."""
    true = np.full((len(wanted_ns), space.size), np.nan)
    if len(members) < space.n or any(track.external for track in members):
        return true
    t_ns, indices = common_instants(members)
    _, rows, common = np.intersect1d(wanted_ns, t_ns, assume_unique=True, return_indices=True)
    p_W = np.stack([track.p_W[index[common]] for track, index in zip(members, indices, strict=True)], axis=1)
    yaw = np.stack([track.yaw[index[common]] for track, index in zip(members, indices, strict=True)], axis=1)
    for row, position, heading in zip(rows, p_W, yaw, strict=True):
        try:
            true[row] = space.forward(position, heading)
        except SingularClusterError:
            continue
    return true


def common_instants(tracks: list[Track]) -> tuple[Times, list[NDArray[np.intp]]]:
    """Return the times at which all drones have truth, and their indices in each track."""
    if not tracks:
        return np.zeros(0, np.int64), []
    t_ns = tracks[0].t_ns
    for track in tracks[1:]:
        t_ns = np.intersect1d(t_ns, track.t_ns, assume_unique=True)
    return t_ns, [np.searchsorted(track.t_ns, t_ns) for track in tracks]


def min_separation_m(tracks: list[Track]) -> float | None:
    """Return the minimum true distance [m] between two drones in the air, external ones at the times of their poses.

    If no status ever shows two drones in the air, all samples count. None if there are fewer than two drones.
    """
    simulated = [track for track in tracks if not track.external]  # their truth has more samples
    each = (_min_distance_m(tracks), _min_distance_m(simulated) if len(simulated) < len(tracks) else None)
    return min((distance_m for distance_m in each if distance_m is not None), default=None)


def _min_distance_m(tracks: list[Track]) -> float | None:
    tracks = [track for track in tracks if len(track.t_ns)]
    t_ns, indices = common_instants(tracks)
    if len(tracks) < 2 or not len(t_ns):
        return None
    p_W = np.stack([track.p_W[index] for track, index in zip(tracks, indices, strict=True)], axis=1)
    flying = np.zeros(p_W.shape[:2], bool)
    for column, track in zip(flying.T, tracks, strict=True):
        if track.states:
            latest = np.searchsorted(track.status_t_ns, t_ns, side="right") - 1
            column[:] = np.array([state != "landed" for state in track.states], bool)[np.maximum(latest, 0)]
    if (flying.sum(axis=1) < 2).all():
        flying[:] = True
    min_m = np.inf
    for start in range(0, len(t_ns), BLOCK):
        block, aloft = p_W[start : start + BLOCK], flying[start : start + BLOCK]
        for i in range(len(tracks) - 1):
            distance = np.linalg.norm(block[:, i + 1 :] - block[:, i : i + 1], axis=2)
            both_aloft = aloft[:, i + 1 :] & aloft[:, i : i + 1]
            min_m = min(min_m, float(distance[both_aloft].min(initial=np.inf)))
    return min_m if np.isfinite(min_m) else None


class GoalErrors(NamedTuple):
    """Errors (K, 4n) of a formation against its plan's target; NaN once its trajectory or landing starts.

    The paper's Figure 5 shows these errors, which include the climb from the ground.
    """

    goal: Array  # (4n,) m or rad; NaN for variables that the target does not name
    # est, true: (K, 4n) estimate − goal and truth − goal, angles wrapped to ±π
    est: Array
    true: Array


def goal_errors(formation: Formation, scenario: Scenario | None) -> GoalErrors | None:
    """Return the errors of a formation against its plan's target; None without a planned take-off or a valid target."""
    cluster = cluster_of(scenario, formation.name)
    if scenario is None or cluster is None or not cluster.plan.target or cluster.plan.takeoff_s is None:
        return None
    try:
        space = scenario_space(scenario, cluster)
        goal = named_values(space, cluster.plan.target, "target", np.full(space.size, np.nan))
    except (TrajectoryError, ExpressionError, ValueError, NotTrustedError):
        return None
    later_s = (cluster.plan.trajectory and cluster.plan.trajectory.start_s, cluster.plan.land_s)
    until_s = min((each for each in later_s if each is not None), default=np.inf)
    is_undefined = (formation.t_s[:, None] >= until_s) | ~np.isfinite(goal)
    est, true = (
        np.where(is_undefined, np.nan, space.wrapped(values - np.nan_to_num(goal)))
        for values in (formation.value, formation.true)
    )
    return GoalErrors(goal, est, true)
