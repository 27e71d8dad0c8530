"""Errors of the drones' estimates, and against their references; velocity responses; distances between drones."""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from msgspec import Struct

from zsim.errors import ZsimError
from zsim.math.frames import wrap_angle
from zsim.vehicles.vehicle import vehicle_of
from zsim_analysis.reading.formation import common_instants
from zsim_analysis.reading.recorded_flight import Array, RecordedFlight

SIGMAS = 2.0  # half-width of the drawn band in standard deviations
DEGREES = 6  # degrees of freedom of a drone's NEES: position and velocity
ESTIMATES_MAX = 200_000  # maximum number of estimates evaluated per flight; evaluating them takes about a second
AIRBORNE_PHASES = ("approaching", "path", "holding")  # phases of a reference in which its drone should be airborne
POSITION, YAW = (0, 1, 2), 3  # columns of errors and of velocities: x, y, z, heading
INSTANTS = 1500  # number of times at which distances are computed, more than a figure has pixels across


class EstimateErrors(NamedTuple):
    """Estimate − truth of one drone at K times."""

    t_s: Array  # (K,) simulated time
    error: Array  # (K, 4) x, y, z in W [m], heading wrapped to ±π [rad]
    sigma: Array  # (K, 4) standard deviations of the errors as stated by the estimator
    # (K,) normalised estimation error squared of position and velocity, eᵀ P⁻¹ e; NaN where P is singular. Its mean is
    # DEGREES for a consistent estimator [Bar-Shalom, Li, Kirubarajan 2001, 5.4.2].
    nees: Array

    def share_inside(self, rows: np.ndarray) -> Array:
        """Return the share (4,) of the errors in `rows` that are within SIGMAS standard deviations."""
        return np.mean(np.abs(self.error[rows]) <= SIGMAS * self.sigma[rows], axis=0)


class VelocityResponse(NamedTuple):
    """Commanded and true velocity of one drone at the times of its C commands."""

    t_s: Array  # (C,) simulated time
    # commanded, flown: (C, 4) forward, left, up by the true heading [m/s], yaw rate [rad/s]
    commanded: Array
    flown: Array


def estimate_errors(flight: RecordedFlight) -> dict[str, EstimateErrors]:
    """Return the errors of the estimates of every simulated drone that has both truth and estimates.

    If there are ESTIMATES_MAX estimates or more, only every n-th truth sample is evaluated.
    """
    step = 1 + sum(len(each.t_ns) for each in flight.estimates.values()) // ESTIMATES_MAX
    errors = {}
    for track in flight.tracks:
        if track.external or (estimates := flight.estimates.get(track.name)) is None:
            continue
        t_ns, truth_rows, estimate_rows = np.intersect1d(
            track.t_ns[::step], estimates.t_ns, assume_unique=True, return_indices=True
        )
        truth_rows = truth_rows * step
        position, velocity = (
            estimates.p_W[estimate_rows] - track.p_W[truth_rows],
            estimates.v_W[estimate_rows] - track.truth[truth_rows, 3:6],
        )
        yaw, covariance = (
            wrap_angle(estimates.yaw[estimate_rows] - track.yaw[truth_rows]),
            estimates.covariance[estimate_rows],
        )
        variances = np.diagonal(covariance, axis1=1, axis2=2)[:, :3]
        sigma = np.column_stack([np.sqrt(np.maximum(variances, 0.0)), estimates.yaw_sigma[estimate_rows]])
        squares = nees(np.hstack([position, velocity]), covariance)
        if len(t_ns):
            errors[track.name] = EstimateErrors(t_ns / 1e9, np.column_stack([position, yaw]), sigma, squares)
    return errors


def nees(error: Array, covariance: Array) -> Array:
    """Return eᵀ P⁻¹ e (K,) of errors (K, n) and their covariances (K, n, n); NaN where P is not positive definite."""
    values, vectors = np.linalg.eigh(covariance)
    definite = values[:, 0] > 1e-12 * np.maximum(values[:, -1], 1e-30)  # below this, the divisor is only rounding error
    along = np.einsum("kij,ki->kj", vectors, error)
    squares = np.sum(along**2 / np.where(definite[:, None], values, 1.0), axis=1)
    return np.where(definite, squares, np.nan)


class ReferenceErrors(NamedTuple):
    """Truth − reference of one drone at the K times at which its reference is in one of AIRBORNE_PHASES."""

    t_s: Array  # (K,) simulated time
    error: Array  # (K, 4) x, y, z in W [m], heading wrapped to ±π [rad]
    reference: Array  # (K, 3) reference position in W [m]
    on_path: np.ndarray  # (K,) bool: on its path, neither approaching it nor holding a position


class Tracking(Struct, frozen=True):
    """Errors of one drone against its reference, within a window and in the air; None without such samples."""

    true_rms_m: float | None
    true_max_m: float | None
    yaw_rms_rad: float | None
    path_rms_m: float | None  # while on its path


def reference_errors(flight: RecordedFlight) -> dict[str, ReferenceErrors]:
    """Return the errors of every simulated drone that has both truth and a reference."""
    errors = {}
    for track in flight.tracks:
        if track.external or (references := flight.references.get(track.name)) is None:
            continue
        is_flown = np.isin(references.phases, AIRBORNE_PHASES)
        t_ns, truth_rows, reference_rows = np.intersect1d(
            track.t_ns, references.t_ns[is_flown], assume_unique=True, return_indices=True
        )
        pose = references.place[is_flown][reference_rows]
        yaw = wrap_angle(track.yaw[truth_rows] - pose[:, 3])
        error = np.column_stack([track.p_W[truth_rows] - pose[:, :3], yaw])
        on_path = np.array(references.phases)[is_flown][reference_rows] == "path"
        if len(t_ns):
            errors[track.name] = ReferenceErrors(t_ns / 1e9, error, pose[:, :3], on_path)
    return errors


def tracking_of(errors: ReferenceErrors, window_s: tuple[float, float]) -> Tracking:
    rows = (errors.t_s >= window_s[0]) & (errors.t_s <= window_s[1])
    offset_m = np.linalg.norm(errors.error[:, :3], axis=1)

    def rms(values: Array) -> float | None:
        return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None

    max_offset_m = float(offset_m[rows].max()) if rows.any() else None
    return Tracking(rms(offset_m[rows]), max_offset_m, rms(errors.error[rows, 3]), rms(offset_m[rows & errors.on_path]))


def velocity_responses(flight: RecordedFlight) -> dict[str, VelocityResponse]:
    """Return the velocities of every simulated drone that has both truth and velocity commands."""

    def in_heading(v_W: Array) -> Array:
        """Convert velocities (K, 3) from W to forward, left and up."""
        return np.column_stack([c * v_W[:, 0] + s * v_W[:, 1], c * v_W[:, 1] - s * v_W[:, 0], v_W[:, 2]])

    responses = {}
    for track in flight.tracks:
        if track.external or (commands := flight.commands.get(track.name)) is None:
            continue
        t_ns, truth_rows, command_rows = np.intersect1d(
            track.t_ns, commands.t_ns, assume_unique=True, return_indices=True
        )
        c, s = np.cos(track.yaw[truth_rows]), np.sin(track.yaw[truth_rows])
        measured = np.column_stack([in_heading(track.truth[truth_rows, 3:6]), track.yaw_rate[truth_rows]])
        velocity = commands.velocity[command_rows]
        heading_velocity = np.where(commands.in_W[command_rows][:, None], in_heading(velocity), velocity)
        if len(t_ns):
            commanded = np.column_stack([heading_velocity, commands.yaw_rate[command_rows]])
            responses[track.name] = VelocityResponse(t_ns / 1e9, commanded, measured)
    return responses


class Distances(NamedTuple):
    """True distances between drones at K times."""

    t_s: Array  # (K,) simulated time
    pairs: tuple[tuple[str, str], ...]  # names, in the order of the columns of `between`
    between: Array  # (K, P) distance of each pair [m]; no columns if there are more pairs than requested
    nearest: Array  # (K, N) distance of each drone to its nearest neighbour [m]


class Separations(NamedTuple):
    """Distance limits [m]: the controllers' margin and alarm, and the contact of two hulls; None if unknown."""

    margin_m: float | None
    alarm_m: float | None
    touch_m: float | None


def distances(flight: RecordedFlight, pairs_max: int) -> Distances | None:
    """Return the distances between simulated drones, also by pair if there are at most `pairs_max`; None if unknown."""
    tracks = [track for track in flight.tracks if len(track.t_ns) and not track.external]
    t_ns, indices = common_instants(tracks)
    if len(tracks) < 2 or not len(t_ns):
        return None
    rows = np.unique(np.linspace(0, len(t_ns) - 1, INSTANTS).astype(int))
    p_W = np.stack([track.p_W[index[rows]] for track, index in zip(tracks, indices, strict=True)], axis=1)
    nearest = np.full(p_W.shape[:2], np.inf)
    between, pairs = [], []
    for i, j in combinations(range(len(tracks)), 2):
        distance_m = np.linalg.norm(p_W[:, i] - p_W[:, j], axis=1)
        nearest[:, i] = np.minimum(nearest[:, i], distance_m)
        nearest[:, j] = np.minimum(nearest[:, j], distance_m)
        if len(tracks) * (len(tracks) - 1) // 2 <= pairs_max:
            between.append(distance_m)
            pairs.append((tracks[i].name, tracks[j].name))
    columns = np.column_stack(between) if between else np.zeros((len(rows), 0))
    return Distances(t_ns[rows] / 1e9, tuple(pairs), columns, nearest)


def separations(flight: RecordedFlight) -> Separations:
    """Return the distance limits of a flight's scenario: the largest among its clusters and among pairs of hulls."""
    gains = [cluster.gains for cluster in flight.scenario.clusters] if flight.scenario else []
    margin_m = max((each.separation_min_m for each in gains), default=None)
    alarm_m = max((each.separation_alarm_m for each in gains), default=None)
    drones = flight.scenario.drones if flight.scenario else ()
    try:
        radii_m = sorted(vehicle_of(drone.model).airframe.hull_radius_m for drone in drones)
    except ZsimError:  # a user's model that is not available here
        radii_m = []
    return Separations(margin_m, alarm_m, sum(radii_m[-2:]) if len(radii_m) > 1 else None)
