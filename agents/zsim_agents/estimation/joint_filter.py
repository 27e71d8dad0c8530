"""The joint filter of a cluster's drones: one covariance of all their errors, corrected by mutual sightings.

Each estimator process of such a cluster reads the sensors of all drones in the cluster and computes the same filter,
but publishes the estimates of its own drones only. For each sighting, the drone that wears the hat is identified; the
sighting is compared with the states of both drones at the time of the picture, and corrects all drones. Errors are
defined as in strapdown.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Estimate, Sightings
from zsim.contract.framing import GateMessages, PerPattern
from zsim.contract.snapshot import State
from zsim.errors import DecodeError
from zsim.math.compiled import Field, columns, portable
from zsim.math.rotation import Vector, add, cross, dot, matrix, norm, product, scaled, subtract, transposed
from zsim.scenario.scenario import Drone, Environment, Estimation, Scenario
from zsim.sensors.camera import Hats
from zsim.sensors.camera_model import camera_pose
from zsim_agents.estimation import measurement_update, strapdown
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.estimator_bank import EstimatorBank, sort_readings, write_estimate
from zsim_agents.estimation.filter_state import COUNT, NOMINAL, SETTING, Array, Moment, Rows, moment, vector
from zsim_agents.estimation.kalman_update import (
    add_innovation_covariance,
    add_projection,
    block,
    predict_jointly,
    put_block,
    within_gates,
)
from zsim_agents.estimation.measurement_update import correct_all
from zsim_agents.estimation.strapdown import ATTITUDE, POSITION, VELOCITY, move_columns, recall_known

SIGHTINGS_MAX = 1000  # maximum number used per gate; more indicate a flood
PICTURES_KEPT = 256  # number of used pictures remembered: 1.4 s of those of 12 drones at 15 Hz
SIGHTING = columns(  # sighting of one hat
    "SightingColumns",
    (
        Field("drone", "1"),  # the observer
        Field("t_arrival", "s"),
        Field("t_sample", "s"),
        Field("camera", "1"),  # index among the observer's cameras
        Field("p_BK", "m", 3),  # position of the camera
        Field("direction_B", "1", 3),
        Field("range", "m"),
        Field("sigma_direction", "rad"),
        Field("sigma_range", "m"),
    ),
)
NO_SIGHTINGS = np.empty((0, SIGHTING.size))
# Minimum difference of y^T S^-1 y between the best and the second-best hat; design choice: a likelihood ratio of 150
AMBIGUITY = 10.0
# Standard deviations by which the positions of two hats must differ: while the filter knows them less well, as when GPS
# is averaged on the ground, one hat is occasionally mistaken for another, and the mistake persists.
SEPARATION_SIGMAS = 6.0
NEAREST_M = 0.1  # minimum distance of a hat; closer, its direction is undefined
RANGE_MAX_M = 1e4  # maximum distance at which a hat is seen
SIGMA_MIN_RAD, SIGMA_MIN_M = 1e-4, 1e-3  # minimum standard deviations: errors of interpolating past states
NO_DRONE = -1

Picture = tuple[int, str, int]  # drone, camera, time of exposure [ns]
Sighting = tuple[float, ...]  # columns SIGHTING


class ClusterBanks:
    """A JointBank per cluster and an EstimatorBank per drone in no cluster, with the methods of one EstimatorBank.

    Attributes:
        drones: drones whose sensors are needed; `receive` takes indices into this list.
    """

    def __init__(self, scenario: Scenario, drones: Sequence[str], gate_s: float) -> None:
        clusters = {drone: tuple(cluster.drones) for cluster in scenario.clusters for drone in cluster.drones}
        groups = list(dict.fromkeys(clusters.get(drone, (drone,)) for drone in drones))
        settings = (scenario.environment, scenario.estimation, gate_s)
        self._banks = [
            (JointBank if len(group) > 1 else EstimatorBank)([scenario.drone(name) for name in group], *settings)
            for group in groups
        ]
        self.drones = [drone for group in groups for drone in group]
        self._slots = [(bank, i) for bank, group in zip(self._banks, groups, strict=True) for i in range(len(group))]
        self._own_indices = [self.drones.index(drone) for drone in drones]

    def receive(self, i: int, sensor: str, message: Any, t_arrival_s: float) -> None:
        bank, slot = self._slots[i]
        bank.receive(slot, sensor, message, t_arrival_s)

    def receive_gate(self, gate: GateMessages) -> bool:
        if len(self._banks) > 1:
            return False  # one bank might accept the gate and another refuse it
        return self._banks[0].receive_gate(gate)

    def estimate(self, t_s: float) -> list[StateEstimate]:
        if len(self._banks) == 1:
            return self._banks[0].estimate(t_s, self._own_indices)
        estimates = [each for bank in self._banks for each in bank.estimate(t_s)]
        return [estimates[slot] for slot in self._own_indices]

    def warm_start(self, i: int, last: StateEstimate | Estimate) -> None:
        bank, slot = self._slots[self._own_indices[i]]
        bank.warm_start(slot, last)

    def snapshot(self) -> State:
        return {"banks": [bank.snapshot() for bank in self._banks]}

    def restore(self, state: State) -> None:
        for bank, saved in zip(self._banks, state["banks"], strict=True):
            bank.restore(saved)


class JointBank(EstimatorBank):
    """Fuses the sensor readings and sightings of a cluster's drones; arguments as for EstimatorBank."""

    counted = (
        *EstimatorBank.counted,
        (keys.SIGHTINGS, COUNT.sightings_used - COUNT.used, COUNT.sightings_refused - COUNT.used),
    )

    def __init__(
        self, drones: Sequence[Drone], environment: Environment, estimation: Estimation, gate_s: float
    ) -> None:
        super().__init__(drones, environment, estimation, gate_s)
        count, n = self.rows.covariance.shape[:2]
        joint = np.zeros((count * n, count * n))
        for i in range(count):
            put_block(joint, i, self.rows.covariance[i])
        self.rows = self.rows._replace(joint=joint, sighted=np.full((count, count), -math.inf))
        hats = environment.hats if isinstance(environment.hats, Hats) else Hats()
        x, y, z = hats.position_m
        self._hat_B: Vector = float(x), float(y), float(z)
        self._cameras = [  # for each drone, the index and the position of each camera
            {name: (k, *camera_pose(camera).p_BK.tolist()) for k, (name, camera) in enumerate(cameras.items())}
            for cameras in (drone.sensors.cameras() for drone in drones)
        ]
        self._drones = {keys.sensor(drone.name, keys.SIGHTINGS): i for i, drone in enumerate(drones)}
        self._entries = PerPattern(self._sighting_entries)
        self._sightings: dict[Picture, tuple[str, list[Sighting]]] = {}  # this gate's, with the name of the detector
        self._hat_count = 0  # number of hats in this gate, including those of replaced sightings
        self._pictures_used: dict[Picture, None] = {}

    def receive(self, i: int, sensor: str, message: Any, t_arrival_s: float) -> None:
        if sensor == keys.SIGHTINGS:
            self._receive_sightings(i, message, t_arrival_s)
        else:
            super().receive(i, sensor, message, t_arrival_s)

    def _receive_sightings(self, i: int, message: Sightings, t_arrival_s: float) -> None:
        camera = self._cameras[i].get(message.camera)
        if camera is None or not message.seen:
            return
        # Two detectors that search the same picture make the same errors, so only one is used. In one gate it is the
        # first by name, whichever arrived first, so that all estimators of the cluster use the same one.
        picture = (i, message.camera, message.t_sample_ns)
        other = self._sightings.get(picture)
        if picture in self._pictures_used or (other is not None and other[0] <= message.source):
            return
        exposure = i, t_arrival_s, message.t_sample_ns * 1e-9, *camera
        rows = [
            (*exposure, *seen.direction_B, seen.range_m, seen.sigma_direction_rad, seen.sigma_range_m)
            for seen in message.seen[: SIGHTINGS_MAX - self._hat_count]
        ]
        self._hat_count += len(rows)
        self._sightings[picture] = (message.source, rows)

    def receive_gate(self, gate: GateMessages) -> bool:
        if not super().receive_gate(gate):
            return False
        for m, i, key in self._entries.of(gate):
            try:
                message = messages.decode(key, gate.payload(m))
            except DecodeError:
                continue
            self._receive_sightings(i, message, message.t_ns * 1e-9)
        return True

    def _sighting_entries(self, gate: GateMessages) -> list[tuple[int, int, str]]:
        """Return the index in the gate, the drone and the key of each message that contains sightings."""
        by_message = ((m, gate.table[which]) for m, which in enumerate(gate.which.tolist()))
        return [(m, self._drones[key], key) for m, key in by_message if key in self._drones]

    def warm_start(self, i: int, last: StateEstimate | Estimate) -> None:
        super().warm_start(i, last)
        put_block(self.rows.joint, i, self.rows.covariance[i])

    def snapshot(self) -> State:
        return {**super().snapshot(), "pictures": [list(picture) for picture in self._pictures_used]}

    def restore(self, state: State) -> None:
        super().restore(state)
        self._pictures_used = dict.fromkeys((i, camera, t_ns) for i, camera, t_ns in state["pictures"])

    def use(self, t_s: float, readings: Array) -> Array:
        sightings = NO_SIGHTINGS
        if self._sightings:
            seen = sorted(row for _, picture_rows in self._sightings.values() for row in picture_rows)
            sightings = np.array(seen) if seen else NO_SIGHTINGS
            self._pictures_used |= dict.fromkeys(self._sightings)
            while len(self._pictures_used) > PICTURES_KEPT:
                del self._pictures_used[next(iter(self._pictures_used))]
            self._sightings, self._hat_count = {}, 0
        step_jointly(self.rows, t_s, readings, sightings, self._hat_B, self._estimates)
        return self._estimates


@portable
def step_jointly(rows: Rows, t_s: float, readings: Array, sightings: Array, hat_B: Vector, estimates: Array) -> None:
    """Use all drones' readings and sightings of a gate, and write the estimates at `t_s` [s].

    Args:
        readings: (M, READING.size); those of each drone are in order of arrival.
        sightings: (M, SIGHTING.size); those from the same picture are adjacent.
        hat_B: centre of a hat in the body frame of its drone [m].
        estimates: filled by this function, (N, ESTIMATE.size).
    """
    count, n = rows.covariance.shape[:2]
    first, after = np.full(count, -1), np.full(readings.shape[0], -1)
    sort_readings(rows, readings, first, after)
    for i in range(count):
        _grow(rows, i, t_s)
    for i in range(count):
        P = block(rows.joint, i, n)
        if not rows.counts[i, COUNT.heading_known]:
            measurement_update.start_heading(rows, i, P, t_s, readings, first[i], after)
            put_block(rows.joint, i, P)
        measurement_update.fuse(rows, i, P, readings, first[i], after)
    use_sightings(rows, sightings, hat_B)
    for i in range(count):
        strapdown.clone(rows, i, rows.joint, i * n)
        rows.covariance[i] = block(rows.joint, i, n)
        write_estimate(rows.nominal[i], rows.setting[i], rows.covariance[i], t_s, estimates[i])


@portable
def _grow(rows: Rows, i: int, t_s: float) -> None:
    row, n = rows.nominal[i], rows.covariance.shape[1]
    if not rows.counts[i, COUNT.running]:
        strapdown.begin(row, rows.counts[i], t_s)
    strapdown.coast(row, rows.setting[i], t_s)
    if row[NOMINAL.t] > row[NOMINAL.t_start]:
        F, Q = np.eye(n), np.zeros((n, n))
        strapdown.write_growth(rows, i, F, Q)
        predict_jointly(rows.joint, i, F, Q)
    strapdown.begin_interval(row, row[NOMINAL.t])


@portable
def use_sightings(rows: Rows, sightings: Array, hat_B: Vector) -> None:
    """Use the sightings of a gate one by one; count those that are implausible or match no hat as refused."""
    claimed = np.zeros(rows.nominal.shape[0], dtype=np.bool_)
    HJ, S, y = np.zeros((3, rows.joint.shape[0])), np.zeros((3, 3)), np.zeros(3)
    for m in range(sightings.shape[0]):
        sighting, i = sightings[m], int(sightings[m, SIGHTING.drone])
        if m == 0 or not is_same_picture(sighting, sightings[m - 1]):
            claimed[:] = False
        j = identified_drone(rows, sighting, hat_B, claimed, HJ, S, y) if is_plausible(rows, sighting) else NO_DRONE
        if j == NO_DRONE:
            rows.counts[i, COUNT.sightings_refused] += 1
            continue
        claimed[j] = True
        rows.counts[i, COUNT.sightings_used] += 1
        rows.sighted[i, j] = sighting[SIGHTING.t_sample]
        correct_all(rows, HJ, S, y)


@portable
def is_same_picture(one: Array, other: Array) -> bool:
    """Return whether two sightings are of the same drone, camera and exposure."""
    is_same_camera = one[SIGHTING.drone] == other[SIGHTING.drone] and one[SIGHTING.camera] == other[SIGHTING.camera]
    return is_same_camera and one[SIGHTING.t_sample] == other[SIGHTING.t_sample]


@portable
def is_plausible(rows: Rows, sighting: Array) -> bool:
    """Return whether a sighting's time and values are plausible, and its observer's heading is known."""
    i = int(sighting[SIGHTING.drone])
    age_s = sighting[SIGHTING.t_arrival] - sighting[SIGHTING.t_sample]
    is_valid = 0.0 <= age_s <= rows.setting[i, SETTING.age_max] and rows.counts[i, COUNT.heading_known] != 0
    is_valid = is_valid and 0.0 < sighting[SIGHTING.range] < RANGE_MAX_M
    length = norm(vector(sighting, SIGHTING.direction_B))
    return is_valid and 0.99 < length < 1.01 and sighting[SIGHTING.sigma_range] > 0.0


@portable
def identified_drone(rows: Rows, sighting: Array, hat_B: Vector, claimed: Array, HJ: Array, S: Array, y: Array) -> int:
    """Return the drone whose hat was seen; NO_DRONE if no hat fits, or another hat could have been seen.

    HJ, S and the innovation y, (3,), are filled for the returned drone; `claimed` marks drones whose hats have already
    been seen in the picture.
    """
    count, i = rows.nominal.shape[0], int(sighting[SIGHTING.drone])
    positions, seen = np.zeros((count, 3)), place_of(sighting)
    best, second, found = math.inf, math.inf, NO_DRONE
    trial_HJ, trial_S = np.zeros_like(HJ), np.zeros_like(S)
    best_axes = across((1.0, 0.0, 0.0))
    for j in range(count):
        if j == i:
            continue
        if not rows.counts[j, COUNT.heading_known]:
            return NO_DRONE  # it could be anywhere
        r, axes = predict_sighting(rows, sighting, j, hat_B, trial_HJ, trial_S)
        positions[j, 0], positions[j, 1], positions[j, 2] = r[0], r[1], r[2]
        trial_y = innovation(axes, seen, r)
        distance = distance_squared(rows, trial_S, trial_y)
        if distance < best:
            best, second, found, best_axes = distance, best, j, axes
            HJ[:], S[:], y[:] = trial_HJ, trial_S, trial_y
        elif distance < second:
            second = distance
    if found == NO_DRONE or best > rows.limits[3] or second - best < AMBIGUITY or claimed[found]:
        return NO_DRONE
    r = (positions[found, 0], positions[found, 1], positions[found, 2])
    for j in range(count):
        if j not in (i, found):
            other = (positions[j, 0], positions[j, 1], positions[j, 2])
            if distance_squared(rows, S, innovation(best_axes, other, r)) < SEPARATION_SIGMAS * SEPARATION_SIGMAS:
                return NO_DRONE
    return found


@portable
def predict_sighting(
    rows: Rows, sighting: Array, j: int, hat_B: Vector, HJ: Array, S: Array
) -> tuple[Vector, tuple[Vector, Vector, Vector]]:
    """Return the expected position of drone j's hat from the camera, and axes along and across the line of sight.

    Fill HJ with H J, (3, D), and S with the covariance of the innovation, (3, 3), both along these axes.
    """
    i, n = int(sighting[SIGHTING.drone]), rows.covariance.shape[1]
    t_s = sighting[SIGHTING.t_sample]
    a, lag_a, state_a = recall_known(rows, i, t_s, moment(rows.nominal[i]))
    b, lag_b, state_b = recall_known(rows, j, t_s, moment(rows.nominal[j]))
    r = expected(a, b, hat_B, vector(sighting, SIGHTING.p_BK))
    distance_m = max(norm(r), NEAREST_M)
    axes = across(scaled(r, 1.0 / distance_m))
    H_i, H_j = np.zeros((3, n)), np.zeros((3, n))
    write_rows(H_i, H_j, a, b, hat_B, axes, (lag_a, lag_b))
    move_columns(H_i, 0, 3, state_a)
    move_columns(H_j, 0, 3, state_b)
    sigma_across = distance_m * max(sighting[SIGHTING.sigma_direction], SIGMA_MIN_RAD)
    sigma_along = max(sighting[SIGHTING.sigma_range], SIGMA_MIN_M)
    HJ[:], S[:] = 0.0, 0.0
    S[0, 0], S[1, 1], S[2, 2] = sigma_along * sigma_along, sigma_across * sigma_across, sigma_across * sigma_across
    add_projection(rows.joint, H_i, i * n, HJ)
    add_projection(rows.joint, H_j, j * n, HJ)
    add_innovation_covariance(HJ, H_i, i * n, S)
    add_innovation_covariance(HJ, H_j, j * n, S)
    return r, axes


@portable
def expected(a: Moment, b: Moment, hat_B: Vector, p_BK: Vector) -> Vector:
    """Return the position of drone b's hat relative to drone a's camera [m; axes of a's body]."""
    offset_W = subtract(add(b[1], product(matrix(b[3]), hat_B)), a[1])
    return subtract(product(transposed(matrix(a[3])), offset_W), p_BK)


@portable
def write_rows(
    H_i: Array,
    H_j: Array,
    a: Moment,
    b: Moment,
    hat_B: Vector,
    axes: tuple[Vector, Vector, Vector],
    lags: tuple[float, float],
) -> None:
    """Write the Jacobians, (3, n), of a sighting along three axes, given in the observer's body frame.

    H_i is with respect to the errors of the observer, H_j to those of the observed drone; both are zero on entry.
    """
    R_a, hat_W = matrix(a[3]), product(matrix(b[3]), hat_B)
    offset_W = subtract(add(b[1], hat_W), a[1])
    for r in range(3):
        w = product(R_a, axes[r])
        by_own, by_other = cross(w, offset_W), cross(hat_W, w)
        for k in range(3):
            H_j[r, POSITION + k] = w[k]
            H_i[r, POSITION + k] = -w[k]
            H_j[r, VELOCITY + k] = -lags[1] * w[k]
            H_i[r, VELOCITY + k] = lags[0] * w[k]
            H_i[r, ATTITUDE + k] = by_own[k]
            H_j[r, ATTITUDE + k] = by_other[k]


@portable
def across(d: Vector) -> tuple[Vector, Vector, Vector]:
    """Return a unit vector, and two more that are perpendicular to it and to each other."""
    reference = (0.0, 0.0, 1.0) if abs(d[2]) < 0.9 else (1.0, 0.0, 0.0)
    e = cross(d, reference)
    e = scaled(e, 1.0 / norm(e))
    return d, e, cross(d, e)


@portable
def innovation(axes: tuple[Vector, Vector, Vector], seen: Vector, r: Vector) -> Array:
    """Return the measured minus the expected position of a hat, along and across the line of sight, (3,) [m]."""
    residual = subtract(seen, r)
    return np.array([dot(axes[0], residual), dot(axes[1], residual), dot(axes[2], residual)])


@portable
def distance_squared(rows: Rows, S: Array, y: Array) -> float:
    blocks, distances = np.array([[0, 3]]), np.zeros(1)
    within_gates(S, y, blocks, rows.limits, distances)
    return distances[0]


@portable
def place_of(sighting: Array) -> Vector:
    """Return the measured position of a hat relative to the camera [m; body axes]."""
    return scaled(vector(sighting, SIGHTING.direction_B), sighting[SIGHTING.range])
