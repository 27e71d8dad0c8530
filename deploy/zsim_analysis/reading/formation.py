"""A formation flight as arrays: desired, estimated and true variables, and their figures of merit. Pure."""

from dataclasses import dataclass

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.errors import NotTrustedError
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, SingularClusterError
from zsim_agents.formation.spaces.scenario_space import cluster_space, scenario_space
from zsim_analysis.reading.recorded_flight import Array, ClusterStates, RecordedFlight, Times, Track
from zsim_analysis.reading.window_text import span_text

BLOCK = 512  # instants whose distances are held at once


class ParameterErrors(Struct, frozen=True):
    """Deviations of one cluster parameter from its desired value, in its own unit (m or rad).

    `est` is what the controller saw (estimate − desired), `true` what the drones did (truth − desired), at
    the same instants. std² + mean² = rms². None: no such instant.
    """

    est_std: float | None
    est_rms: float | None
    est_mean: float | None
    true_std: float | None
    true_rms: float | None
    true_mean: float | None


def errors(est: Array, true: Array) -> ParameterErrors:
    """Return the statistics of one parameter; `est` and `true` (K,), not finite where unknown."""
    both = np.isfinite(est) & np.isfinite(true)
    return ParameterErrors(*_moments(est[both] if both.any() else est), *_moments(true[both]))


def _moments(error: Array) -> tuple[float | None, float | None, float | None]:
    error = error[np.isfinite(error)]
    if not len(error):
        return None, None, None
    return float(error.std()), float(np.sqrt(np.mean(error**2))), float(error.mean())


def window(wanted_s: tuple[float, float] | None, length_s: float) -> tuple[tuple[float, float], str]:
    """Return the window of the statistics [s] of a run, and a note where it is not the one of the scenario.

    Without one in the scenario: the last two thirds of the run.
    """
    default = (length_s / 3, length_s)
    if wanted_s is None:
        return default, ""
    start, end = wanted_s
    if end <= length_s:
        return wanted_s, ""
    if start < length_s:
        return (start, length_s), f"The run ended at {length_s:.2f} s, inside the window {span_text(wanted_s)}."
    return default, (
        f"The run ended at {length_s:.2f} s, before the window {span_text(wanted_s)}; "
        "the last two thirds of what there is are used."
    )


def common_instants(tracks: list[Track]) -> tuple[Times, list[NDArray[np.intp]]]:
    """Return the instants at which all drones have truth, and where they stand in each track."""
    if not tracks:
        return np.zeros(0, np.int64), []
    t_ns = tracks[0].t_ns
    for track in tracks[1:]:
        t_ns = np.intersect1d(t_ns, track.t_ns, assume_unique=True)
    return t_ns, [np.searchsorted(track.t_ns, t_ns) for track in tracks]


def min_separation_m(tracks: list[Track]) -> float | None:
    """Return the least true distance [m] of two drones that are both in the air, external ones where they are known.

    Where no status shows a drone in the air, all instants count; None when there are no two drones.
    """
    simulated = [track for track in tracks if not track.external]  # whose truth has more instants
    each = (_least_m(tracks), _least_m(simulated) if len(simulated) < len(tracks) else None)
    return min((least for least in each if least is not None), default=None)


def _least_m(tracks: list[Track]) -> float | None:
    tracks = [track for track in tracks if len(track.t_ns)]
    t_ns, places = common_instants(tracks)
    if len(tracks) < 2 or not len(t_ns):
        return None
    p_W = np.stack([track.p_W[place] for track, place in zip(tracks, places, strict=True)], axis=1)
    flying = np.stack([_airborne(track, t_ns) for track in tracks], axis=1)
    if (flying.sum(axis=1) < 2).all():
        flying[:] = True
    blocks = (slice(start, start + BLOCK) for start in range(0, len(t_ns), BLOCK))
    least = min(_least_distance(p_W[block], flying[block]) for block in blocks)
    return float(least) if np.isfinite(least) else None


def _airborne(track: Track, t_ns: Times) -> NDArray[np.bool_]:
    flying = np.array([state != "landed" for state in track.states], bool)
    if not len(flying):
        return np.zeros(len(t_ns), bool)
    latest = np.searchsorted(track.status_t_ns, t_ns, side="right") - 1
    return flying[np.maximum(latest, 0)]


def _least_distance(p_W: Array, flying: NDArray[np.bool_]) -> float:
    """Return the least distance in positions (T, N, 3) of pairs that both fly (T, N)."""
    least = np.inf
    for i in range(p_W.shape[1] - 1):
        distance = np.linalg.norm(p_W[:, i + 1 :] - p_W[:, i : i + 1], axis=2)
        both = flying[:, i + 1 :] & flying[:, i : i + 1]
        least = min(least, float(distance[both].min(initial=np.inf)))
    return least


@dataclass
class Formation:
    """K instants of a cluster of n drones; m or rad, NaN where unknown.

    Attributes:
        t_s: (K,) simulated time.
        desired, value, true: (K, 4n).
        est_error, true_error: (K, 4n) value − desired and true − desired, angles the short way.
        phases: (K,).
    """

    name: str
    drones: tuple[str, ...]
    names: tuple[str, ...]
    t_s: Array
    desired: Array
    value: Array
    true: Array
    est_error: Array
    true_error: Array
    phases: list[str]

    def column(self, name: str) -> int:
        return self.names.index(name)

    @property
    def engaged_s(self) -> float | None:
        """Return when it was engaged first, None where it never was."""
        return next((float(t_s) for t_s, phase in zip(self.t_s, self.phases, strict=True) if phase == "engaged"), None)

    @property
    def since_engaged(self) -> NDArray[np.bool_]:
        """Return which instants (K,) are not before the engagement; all where it never was."""
        return self.t_s >= (-np.inf if self.engaged_s is None else self.engaged_s)

    def within(self, window_s: tuple[float, float]) -> np.ndarray:
        """Return which instants (K,) are in a window."""
        return (self.t_s >= window_s[0]) & (self.t_s <= window_s[1])

    def judged(self, window_s: tuple[float, float]) -> NDArray[np.bool_]:
        """Return which instants (K,) of a window are judged: at others the desired value is the estimate's own."""
        return self.within(window_s) & np.array([phase == "engaged" for phase in self.phases], bool)

    def engaged_share(self, window_s: tuple[float, float]) -> float | None:
        """Return at which share of a window's instants it was engaged, None without any instant."""
        rows = self.within(window_s)
        return float(self.judged(window_s).sum() / rows.sum()) if rows.any() else None

    def errors(self, window_s: tuple[float, float]) -> dict[str, ParameterErrors]:
        """Return the statistics of every parameter over the engaged part of a window."""
        rows = self.judged(window_s)
        return {name: errors(self.est_error[rows, i], self.true_error[rows, i]) for i, name in enumerate(self.names)}


def formations_of(flight: RecordedFlight) -> list[Formation]:
    """Return the clusters of a flight whose variables can be judged."""
    formations = (formation(states, flight.tracks, flight.scenario) for states in flight.clusters)
    return [each for each in formations if each]


def formation(states: ClusterStates, tracks: list[Track], scenario: Scenario | None) -> Formation | None:
    """Return a cluster's formation.

    None if its controller published nothing, or variables of another convention than the scenario's.
    """
    by_name = {track.name: track for track in tracks}
    space = _space(states, scenario) if len(states.t_ns) else None
    if space is None or states.names != space.names:
        return None
    value, desired = _known(states.value), _known(states.desired)
    members = [by_name[name] for name in states.drones if name in by_name]
    true = _true(space, members, states.t_ns)
    return Formation(
        name=states.name,
        drones=states.drones,
        names=states.names,
        t_s=states.t_ns / 1e9,
        desired=desired,
        value=value,
        true=true,
        est_error=_difference(space, value, desired),
        true_error=_difference(space, true, desired),
        phases=states.phases,
    )


def _space(states: ClusterStates, scenario: Scenario | None) -> ClusterSpace | None:
    """Return the cluster space that a scenario gives the cluster of these states, else that of so many drones."""
    clusters = {cluster.name: cluster for cluster in scenario.clusters} if scenario else {}
    try:
        if scenario and states.name in clusters:
            return scenario_space(scenario, clusters[states.name])
        return cluster_space(len(states.drones))
    except (ValueError, NotTrustedError):
        return None


def _known(rows: Array) -> Array:
    """Return rows (K, 4n) with NaN where all are zero: on the wire that stands for unknown."""
    return np.where(rows.any(axis=1, keepdims=True), rows, np.nan)


def _difference(space: ClusterSpace, to: Array, desired: Array) -> Array:
    """Return to − desired (K, 4n), angles that wrap the short way."""
    return np.array([space.difference(*pair) for pair in zip(to, desired, strict=True)])


def _true(space: ClusterSpace, members: list[Track], wanted_ns: Times) -> Array:
    """Return the cluster variables (K, 4n) of where the drones truly were; NaN without truth or frame.

    Nobody knows where an external one truly is.
    """
    true = np.full((len(wanted_ns), space.size), np.nan)
    if len(members) < space.n or any(track.external for track in members):
        return true
    t_ns, places = common_instants(members)
    _, rows, common = np.intersect1d(wanted_ns, t_ns, assume_unique=True, return_indices=True)
    p_W = np.stack([track.p_W[place[common]] for track, place in zip(members, places, strict=True)], axis=1)
    yaw = np.stack([track.yaw[place[common]] for track, place in zip(members, places, strict=True)], axis=1)
    for row, position, heading in zip(rows, p_W, yaw, strict=True):
        try:
            true[row] = space.forward(position, heading)
        except SingularClusterError:
            continue
    return true
