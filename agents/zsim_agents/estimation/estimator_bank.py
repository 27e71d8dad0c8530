"""Estimators of many drones, stored as rows of arrays, with one compiled step from sensor readings to estimates.

Readings are stored on arrival. At the end of a gate, each drone's nominal state and covariance are propagated with its
IMU (strapdown), and its other readings are tested and used (measurement_update).
"""

import struct
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from zsim.contract import framing, keys, messages
from zsim.contract.flight_messages import Estimate
from zsim.contract.framing import GAP, GateMessages, Layouts, Program
from zsim.contract.keys import SENSORS
from zsim.contract.snapshot import State
from zsim.math import elementary as el
from zsim.math.compiled import inlined, portable
from zsim.math.held import Held, hold
from zsim.math.rotation import axpy, multiply, normalised, scaled
from zsim.scenario.scenario import Drone, Environment, Estimation
from zsim_agents.estimation import measurement_update, strapdown
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.filter_setup import initial_rows
from zsim_agents.estimation.filter_state import (
    BARO,
    COUNT,
    ESTIMATE,
    FLOW,
    GPS,
    IMU,
    LAYOUT,
    NOMINAL,
    READING,
    SETTING,
    SIZES,
    SONAR,
    STATES,
    VALUES_MAX,
    Array,
    Rows,
    put,
    put_quaternion,
    reckoning,
    vector,
)
from zsim_agents.estimation.measurement_update import HEADING_SIGMA_RAD, YAW, set_variance
from zsim_agents.estimation.strapdown import MANOEUVRE_M_S2, acceleration, heading_and_sigma, rotation_vector_quaternion

_READING = struct.Struct(f"{READING.size}d")
_CAPACITY = 256  # initial capacity, in readings per gate
_YAW, _YAW_SIGMA = ESTIMATE.yaw, ESTIMATE.yaw_sigma
_COVARIANCE = slice(ESTIMATE.covariance, _YAW_SIGMA)  # up to the next field
_p_WB, _v_WB, _gyro_bias = (
    itemgetter(first, first + 1, first + 2) for first in (ESTIMATE.p_WB, ESTIMATE.v_WB, ESTIMATE.gyro_bias)
)
_q_WB = itemgetter(*range(ESTIMATE.q_WB, ESTIMATE.q_WB + 4))
_REFUSED = len(SENSORS)  # offset from a sensor's count of used readings to that of refused ones

NO_DRONE = -1
NS_S = 1e-9  # s/ns
BARO_ALTITUDE, GPS_POSITION, GPS_SIGMA, FLOW_QUALITY = 1, 3, 9, 3  # indices among the floats of these messages
GPS_FIX, SONAR_VALID = 3, 3  # indices among the integers of these messages
RANK = tuple(sorted(SENSORS).index(kind) for kind in SENSORS)  # rank of each sensor in the order of delivery, by key

read = inlined(framing.read)

_VALUES: dict[str, Callable[[Any], tuple[float, ...]]] = {  # columns `values` and `extra` of a reading
    "imu": lambda m: (*m.accel_m_s2, *m.gyro_rad_s, 0.0, 0.0),
    "gps": lambda m: (*m.position_m, *m.velocity_m_s, m.sigma_m, m.fix),
    "mag": lambda m: (*m.field_ut, 0.0, 0.0, 0.0, 0.0, 0.0),
    "baro": lambda m: (m.altitude_m, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "sonar": lambda m: (m.range_m, 0.0, 0.0, 0.0, 0.0, 0.0, m.valid, 0.0),
    "flow": lambda m: (*m.velocity_m_s, 0.0, 0.0, 0.0, m.quality, 0.0),
}


class EstimatorBank:
    """Fuses the sensors of several drones; `i` is a drone's index in the given order.

    Between two gates, readings of different sensors may arrive in any order. Duplicates are ignored; readings that are
    older than the sensor's last one, too old, not finite, or outside their innovation gate are refused and counted.

    Attributes:
        counted: name of each sensor, in the order of publication, and the columns of its counts of used and refused
            readings, relative to COUNT.used.
    """

    counted = (*((name, k, _REFUSED + k) for k, name in enumerate(SENSORS) if k != IMU), ("imu", IMU, _REFUSED + IMU))

    def __init__(
        self, drones: Sequence[Drone], environment: Environment, estimation: Estimation, gate_s: float
    ) -> None:
        self.rows, self._estimates = initial_rows(drones, environment, estimation, gate_s)
        self._held, self._held_rows = hold(self.rows), self.rows
        self._readings, self._count = np.empty((0, READING.size)), 0
        self._reserve(_CAPACITY)
        self._reader = GateReader([drone.name for drone in drones])

    def receive(self, i: int, sensor: str, message: Any, t_arrival_s: float) -> None:
        """Store a message that arrived at `t_arrival_s` [s]; messages of sensors outside SENSORS are ignored."""
        if sensor not in _VALUES:
            return
        if self._count == len(self._readings):
            self._reserve(2 * self._count)
        kind, t_sample_s = SENSORS.index(sensor), message.t_sample_ns * 1e-9
        offset, values = self._count * _READING.size, _VALUES[sensor](message)
        _READING.pack_into(
            self._buffer, offset, i, kind, t_sample_s if kind == IMU else t_arrival_s, t_sample_s, *values
        )
        self._count += 1

    def receive_gate(self, gate: GateMessages) -> bool:
        """Store all sensor messages of a gate; store none and return False if one of them must be fully decoded."""
        while self._count + len(gate) > len(self._readings):
            self._reserve(2 * len(self._readings))
        count = self._reader.take(gate, self._readings, self._count)
        if count >= 0:
            self._count = count
        return count >= 0

    def estimate(self, t_s: float, indices: Sequence[int] | None = None) -> list[StateEstimate]:
        """Use the readings since the last gate; return estimates at `t_s` [s] of all drones or of `indices`."""
        count, self._count = self._count, 0
        self.use(t_s, self._readings[:count])
        rows, counts = self._estimates.tolist(), self.rows.counts[:, COUNT.used :].tolist()
        if indices is not None:
            rows, counts = [rows[i] for i in indices], [counts[i] for i in indices]
        return [
            StateEstimate(
                _p_WB(row),
                _v_WB(row),
                _q_WB(row),
                row[_YAW],
                tuple(row[_COVARIANCE]),
                row[_YAW_SIGMA],
                _gyro_bias(row),
                {sensor: (row_counts[used], row_counts[refused]) for sensor, used, refused in self.counted},
            )
            for row, row_counts in zip(rows, counts, strict=True)
        ]

    def use(self, t_s: float, readings: Array) -> Array:
        """Use readings, (M, READING.size), and return the estimates at `t_s` [s], (N, ESTIMATE.size)."""
        if self._held_rows is not self.rows:
            self._held, self._held_rows = hold(self.rows), self.rows
        step(self._held, t_s, readings, self._estimates)
        return self._estimates

    def warm_start(self, i: int, last: StateEstimate | Estimate) -> None:
        """Continue from a published estimate; must be called before the first reading.

        The covariances of tilt and biases, which are not published, remain those of a cold start.
        """
        w, x, y, z = (float(part) for part in last.orientation_wxyz)
        row, setting, P = self.rows.nominal[i], self.rows.setting[i], self.rows.covariance[i]
        row[NOMINAL.p_WB : NOMINAL.p_WB + 3] = last.position_m
        row[NOMINAL.v_WB : NOMINAL.v_WB + 3] = row[NOMINAL.v_start : NOMINAL.v_start + 3] = last.velocity_m_s
        put_quaternion(row, NOMINAL.q_WB, normalised((w, x, y, z)))
        state = reckoning(row)
        put(row, NOMINAL.a_WB, acceleration(state[2], state[5], setting[SETTING.gravity]))
        row[NOMINAL.gyro_bias : NOMINAL.gyro_bias + 3] = last.gyro_bias_rad_s
        P[:6, :6] = np.reshape(last.covariance, (6, 6))
        set_variance(P, YAW, el.square(last.yaw_sigma_rad))
        self.rows.counts[i, COUNT.heading_known] = last.yaw_sigma_rad < HEADING_SIGMA_RAD

    def snapshot(self) -> State:
        return {name: getattr(self.rows, name) for name in STATES}

    def restore(self, state: State) -> None:
        """Continue from the state of a bank for the same drones.

        Raises:
            KeyError, ValueError: an array is missing or has another shape.
        """
        for name in STATES:
            rows = getattr(self.rows, name)
            if state[name].shape != rows.shape:
                raise ValueError(f"{name} is of shape {state[name].shape}; must be {rows.shape}")
            rows[...] = state[name]

    def _reserve(self, readings: int) -> None:
        former, self._buffer = self._readings, bytearray(readings * _READING.size)
        self._readings = np.frombuffer(self._buffer).reshape(readings, READING.size)
        self._readings[: len(former)] = former


@portable
def step(held: Held, t_s: float, readings: Array, estimates: Array) -> None:
    """Use the readings of all drones in a gate, and write the estimates at `t_s` [s].

    Args:
        held: the Rows of N drones, as returned by `hold`; updated in place.
        readings: readings, (M, READING.size); those of each drone are in order of arrival.
        estimates: filled by this function with the estimates, (N, ESTIMATE.size).
    """
    rows = held.content
    count = rows.nominal.shape[0]
    first = np.full(count, -1)
    after = np.full(readings.shape[0], -1)
    sort_readings(rows, readings, first, after)
    for i in range(count):
        _step_one(rows, i, t_s, readings, first[i], after, estimates[i])


@portable
def sort_readings(rows: Rows, readings: Array, first: Array, after: Array) -> None:
    """Propagate the nominal state of each drone with its IMU, and chain those of its aiding readings that are accepted.

    Args:
        readings: readings, (M, READING.size).
        first: index of each drone's first aiding reading, (N,); -1 (none) on entry, modified in place.
        after: index of the same drone's next aiding reading, for each reading, (M,); likewise.
    """
    last = np.full(rows.nominal.shape[0], -1)
    for m in range(readings.shape[0]):
        reading, i = readings[m], int(readings[m, READING.drone])
        if int(reading[READING.sensor]) == IMU:
            accel, gyro = vector(reading, READING.values), vector(reading, READING.values + 3)
            strapdown.move(rows, i, reading[READING.t_sample], accel, gyro)
        elif measurement_update.accept(rows, i, reading):
            if last[i] < 0:
                first[i] = m
            else:
                after[last[i]] = m
            last[i] = m


@portable
def _step_one(rows: Rows, i: int, t_s: float, readings: Array, first: int, after: Array, estimate: Array) -> None:
    """Propagate the covariance of a drone, use its aiding readings, and write its estimate."""
    row, counts, n = rows.nominal[i], rows.counts[i], rows.layout[i, LAYOUT.states]
    if not counts[COUNT.running]:
        strapdown.begin(row, counts, t_s)
    strapdown.coast(row, rows.setting[i], t_s)
    P = strapdown.grow(rows, i, rows.covariance[i, :n, :n].copy())
    if not counts[COUNT.heading_known]:
        measurement_update.start_heading(rows, i, P, t_s, readings, first, after)
    P = measurement_update.fuse(rows, i, P, readings, first, after)
    strapdown.clone(rows, i, P, 0)
    rows.covariance[i, :n, :n] = P
    write_estimate(row, rows.setting[i], P, t_s, estimate)


@portable
def write_estimate(row: Array, setting: Array, P: Array, t_s: float, estimate: Array) -> None:
    """Write the estimate of a drone at `t_s` [s], (ESTIMATE.size,).

    Beyond the last IMU sample, the state is extrapolated with that sample's acceleration, whose noise adds to the
    covariance, as do possible manoeuvres.
    """
    p, v, q, a_W, w, _ = reckoning(row)
    dt = t_s - row[NOMINAL.t]
    if dt > 1e-9:
        p, v = axpy(p, dt, v), axpy(v, dt, a_W)
        q = normalised(multiply(q, rotation_vector_quaternion(scaled(w, dt))))
        P = P[:9, :9].copy()
        P[:3] += dt * P[3:6]
        P[:, :3] += dt * P[:, 3:6]
        velocity = (setting[SETTING.accel_variance] + MANOEUVRE_M_S2 * MANOEUVRE_M_S2) * dt * dt
        for k in range(3):
            P[k, k] += 0.25 * dt * dt * velocity
            P[k, 3 + k] += 0.5 * dt * velocity
            P[3 + k, k] += 0.5 * dt * velocity
            P[3 + k, 3 + k] += velocity
    yaw, yaw_sigma = heading_and_sigma(q, P)
    put(estimate, ESTIMATE.p_WB, p)
    put(estimate, ESTIMATE.v_WB, v)
    put_quaternion(estimate, ESTIMATE.q_WB, q)
    estimate[ESTIMATE.yaw], estimate[ESTIMATE.yaw_sigma] = yaw, yaw_sigma
    put(estimate, ESTIMATE.gyro_bias, vector(row, NOMINAL.gyro_bias))
    for i in range(6):
        for j in range(i, 6):
            estimate[ESTIMATE.covariance + 6 * i + j] = estimate[ESTIMATE.covariance + 6 * j + i] = P[i, j]


class ReaderTables(NamedTuple):
    """The layouts of a gate's messages, for compiled code, and buffers for one message."""

    program: Program
    owner: Array  # drone and sensor of each key in the gate's table, or NO_DRONE twice, (keys, 2)
    ints: Array
    floats: Array
    bits: Array  # view of the floats as integers


class GateReader:
    """Reads the sensor messages of drones, given in the order of the bank, from gates."""

    def __init__(self, drones: Sequence[str]) -> None:
        self._owners = {
            keys.sensor(drone, kind): (i, SENSORS.index(kind)) for i, drone in enumerate(drones) for kind in SENSORS
        }
        self._table: Sequence[str] = ()
        kinds = [messages.type_of(keys.sensor("any", sensor)) for sensor in SENSORS]
        layouts = Layouts(kind for kind in kinds if kind)
        floats, owner = np.zeros(layouts.floats), np.empty((0, 2), dtype=np.int64)
        ints = np.zeros(layouts.ints, dtype=np.int64)
        self._tables = ReaderTables(layouts.program, owner, ints, floats, floats.view(np.uint64))
        self._held = hold(self._tables)

    def take(self, gate: GateMessages, readings: Array, count: int) -> int:
        """Write the readings of a gate to `readings`, (M, READING.size), from row `count` on; they must all fit.

        Returns:
            The new count, or -1 if a message must be fully decoded.
        """
        if gate.table is not self._table:
            self._table = gate.table
            owner = np.array([self._owners.get(key, (NO_DRONE, NO_DRONE)) for key in gate.table], dtype=np.int64)
            self._held = hold(self._tables._replace(owner=owner))
        data = np.frombuffer(gate.buffer, dtype=np.uint8)
        if gate.which.flags.writeable:
            for array in (gate.which, gate.ends, data):
                array.setflags(write=False)  # as received; code for writeable arrays would be compiled separately
        return collect(self._held, gate.which, gate.ends, data, readings, count)


@portable
def collect(held: Held, which: Array, ends: Array, data: Array, readings: Array, count: int) -> int:
    """Write a gate's sensor messages as readings, sorted by time and sensor name per drone; see `GateReader.take`."""
    program, owner, ints, floats, bits = held.content
    start, first = 0, count
    marks = np.empty(which.shape[0], np.int64)
    for m in range(which.shape[0]):
        if not (0 <= which[m] < owner.shape[0] and start + GAP <= ends[m] <= data.shape[0]):
            return -1
        i, kind = owner[which[m], 0], owner[which[m], 1]
        if i >= 0:
            if not read(program, kind, data, start + GAP, ends[m], ints, bits):
                return -1
            slot = count
            mark = ints[0] * len(RANK) + RANK[kind]
            while slot > first and readings[slot - 1, READING.drone] == i and marks[slot - 1 - first] > mark:
                readings[slot], marks[slot - first] = readings[slot - 1], marks[slot - 1 - first]
                slot -= 1
            fill(readings[slot], i, kind, ints, floats)
            marks[slot - first] = mark
            count += 1
        start = ends[m]
    return count


@inlined
def fill(reading: Array, i: int, kind: int, ints: Array, floats: Array) -> None:
    reading[READING.drone], reading[READING.sensor] = i, kind
    reading[READING.t_arrival], reading[READING.t_sample] = ints[0] * NS_S, ints[2] * NS_S
    first = BARO_ALTITUDE if kind == BARO else GPS_POSITION if kind == GPS else 0
    for k in range(VALUES_MAX):
        reading[READING.values + k] = floats[first + k] if k < SIZES[kind] else 0.0
    reading[READING.extra], reading[READING.extra + 1] = 0.0, 0.0
    if kind == IMU:
        reading[READING.t_arrival] = reading[READING.t_sample]
    elif kind == GPS:
        reading[READING.extra], reading[READING.extra + 1] = floats[GPS_SIGMA], ints[GPS_FIX]
    elif kind == SONAR:
        reading[READING.extra] = ints[SONAR_VALID]
    elif kind == FLOW:
        reading[READING.extra] = floats[FLOW_QUALITY]
