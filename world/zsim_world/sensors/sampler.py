"""Samples of a fleet's sensors at a gate, as rows of arrays, held back until their latency has passed.

Values are in the order of the contract's fields. imu: ax, ay, az [m/s^2], gx, gy, gz [rad/s]; gps: latitude,
longitude [deg], altitude [m], e, n, u [m], ve, vn, vu [m/s]; mag: x, y, z [uT]; baro: pressure [Pa], altitude [m];
sonar: range [m], valid (0 or 1); flow: forward, left, up [m/s], quality. The values of a user's sensor are computed in
Python after the gate, from the true state logged by the kernel.

Sightings and scans are also computed after the gate, from the poses of all drones at the sampling times
(`Exposures`, `poses_between`), and held back (`released`).
"""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.snapshot import IN_PLACE, PART, Saved
from zsim.errors import UserCodeError, reason_of
from zsim.math import frames
from zsim.math.compiled import Field, columns, inlined, kernel
from zsim.math.frames import rotation_matrix
from zsim.math.held import Held, hold
from zsim.math.randomness import stream
from zsim.math.rotation import attitude_between, position_between
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim.schema.checker import show
from zsim.sensors.sensor import Sensor, SensorTruth, SensorType
from zsim_world.physics.fleet_arrays import EXPOSED, STATE, Senses, four, vector
from zsim_world.sensors import sensor_set
from zsim_world.sensors.noise import set_generator, words
from zsim_world.sensors.sensor_set import CHANNELS_MAX, CONFIG, SENSORS, FleetSensors, noise_width, read

WHOSE = columns("WhoseColumns", (Field("sensor", "1"), Field("drone", "1"), Field("t", "ns"), Field("t_sample", "ns")))
VALUE_COLUMNS = 9  # number of values of a GPS fix, the longest sample


class Sampled(NamedTuple):
    """Measurements, sorted by (t_ns, drone, sensor)."""

    whose: NDArray[np.int64]  # (M, WHOSE.size)
    values: NDArray[np.float64]  # (M, VALUE_COLUMNS); each sensor uses as many columns as it has values


NONE = Sampled(np.empty((0, WHOSE.size), dtype=np.int64), np.empty((0, VALUE_COLUMNS)))


class SampledLog(NamedTuple):
    """The kernel's log, and the data needed to convert it to samples."""

    whose: NDArray[np.int64]  # (M, 3): sensor, drone, tick
    value: NDArray[np.float64]  # (M, CHANNELS_MAX)
    latency_ns: NDArray[np.int64]  # (N, sensors)
    rows: NDArray[np.float64]  # `rows` and `place` are the results of frames.anchor
    place: NDArray[np.float64]


class Sampler:
    """Converts the kernel's log to samples, and holds back those that are not due yet."""

    SAVED: ClassVar[Saved] = {"_later": Sampled, "_user_sensors": PART}

    def __init__(self, scenario: Scenario, sensors: FleetSensors, senses: Senses) -> None:
        environment = scenario.environment
        latency_ns = sensor_set.latencies(sensors)
        anchor = frames.anchor(environment.latitude_deg, environment.longitude_deg, environment.height_m)
        self._log = SampledLog(senses.whose, senses.value, latency_ns, *anchor)
        self._held = hold(self._log)
        self._tick_ns = round(scenario.time.physics_dt_ms * 1_000_000)
        has_user_sensors = len(sensors.names) > len(SENSORS)
        self._user_sensors = UserSensors(scenario, sensors, senses) if has_user_sensors else None
        self._in_order = not (has_user_sensors or latency_ns.any())
        self._later = NONE

    def due(self, logged: int, now_ns: int) -> Sampled:
        """Return the samples due by `now_ns`, from the first `logged` rows of the log and from the samples held back.

        Raises:
            UserCodeError: the equation of a user's sensor fails.
        """
        held = self._held
        if self._user_sensors is not None:
            user_whose, user_value = self._user_sensors.readings()
            whose = np.concatenate((self._log.whose[:logged], user_whose))
            value = np.concatenate((self._log.value[:logged], user_value))
            held, logged = hold(self._log._replace(whose=whose, value=value)), len(whose)
        new = Sampled(*stamped(held, logged, self._tick_ns))
        if self._in_order:
            return new
        index = np.concatenate((self._later.whose, new.whose))
        values = np.concatenate((self._later.values, new.values))
        is_early = index[:, WHOSE.t] > now_ns
        self._later, due, due_values = Sampled(index[is_early], values[is_early]), index[~is_early], values[~is_early]
        order = np.lexsort((due[:, WHOSE.sensor], due[:, WHOSE.drone], due[:, WHOSE.t]))
        return Sampled(due[order], due_values[order])


@kernel()
def stamped(held: Held, count: int, tick_ns: int) -> tuple[NDArray, NDArray]:
    """Return the fields `whose` and `values` of Sampled for the first `count` rows of a log.

    Args:
        held: the SampledLog, wrapped by `hold`.
        tick_ns: interval between ticks [ns].
    """
    whose, value, latency_ns, rows, origin = held.content
    index, values = np.empty((count, WHOSE.size), np.int64), np.empty((count, VALUE_COLUMNS))
    for m in range(count):
        s, i, first = whose[m, 0], whose[m, 1], 0
        index[m, WHOSE.sensor], index[m, WHOSE.drone], index[m, WHOSE.t_sample] = s, i, whose[m, 2] * tick_ns
        index[m, WHOSE.t] = index[m, WHOSE.t_sample] + latency_ns[i, s]
        if s == sensor_set.GPS:
            values[m, 0:3] = frames.geodetic(value[m : m + 1, 0:3], rows, origin)[0]
            first = 3
        for k in range(sensor_set.CHANNELS_MAX):
            values[m, first + k] = value[m, k]
    return index, values


@inlined
def _is_before(a: NDArray, b: NDArray) -> bool:
    """Return whether `a` does not come after `b` in the order of (t_ns, drone, sensor)."""
    if a[WHOSE.t] != b[WHOSE.t]:
        return a[WHOSE.t] < b[WHOSE.t]
    if a[WHOSE.drone] != b[WHOSE.drone]:
        return a[WHOSE.drone] < b[WHOSE.drone]
    return a[WHOSE.sensor] <= b[WHOSE.sensor]


@kernel()
def insert_rows(whose: NDArray, values: NDArray, inserted: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return measurements with rows of zero values inserted: `whose`, `values` and the indices of the inserted rows.

    Args:
        whose, values: fields of Sampled, sorted as there.
        inserted: rows of `whose` to insert, sorted likewise, (K, WHOSE.size).
    """
    count, extra = whose.shape[0], inserted.shape[0]
    index, numbers = np.empty((count + extra, WHOSE.size), np.int64), np.zeros((count + extra, VALUE_COLUMNS))
    places, m = np.empty(extra, np.int64), 0
    for k in range(extra + 1):
        while m < count and (k == extra or _is_before(whose[m], inserted[k])):
            index[m + k], numbers[m + k] = whose[m], values[m]
            m += 1
        if k < extra:
            index[m + k], places[k] = inserted[k], m + k
    return index, numbers, places


class UserSensors:
    """The users' sensors of a fleet. As with stock sensors, each sensor of each drone has its own random stream."""

    SAVED: ClassVar[Saved] = {"sensors": PART}

    def __init__(self, scenario: Scenario, sensors: FleetSensors, senses: Senses) -> None:
        self._senses = senses
        self._environment = scenario.environment
        self._tick_s = scenario.time.physics_dt_ms / 1000.0
        self._sensors: dict[tuple[int, int], _UserSensor] = {}
        for i, drone in enumerate(scenario.drones):
            for s in range(len(SENSORS), len(sensors.names)):
                settings = sensors.settings[i][s]
                if settings is not None:
                    name, rng = sensors.names[s], stream(scenario.seed, f"{drone.name}/{sensors.names[s]}")
                    label = f"{drone.name}: sensors.{name}"
                    self._sensors[s, i] = _UserSensor(label, sensors.types[s], settings, rng, senses.config[i, s])

    @property
    def sensors(self) -> list["_UserSensor"]:
        """All users' sensors, drone by drone."""
        return [*self._sensors.values()]

    def readings(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the readings logged in a gate, except lost ones: sensor, drone and tick, (M, 3); values, (M, 6).

        Raises:
            UserCodeError: an equation fails, or returns no valid reading.
        """
        senses, received = self._senses, []
        count = int(senses.exposed_count[0])
        values = np.zeros((count, CHANNELS_MAX))
        for m in range(count):
            s, i, tick = senses.exposed_whose[m].tolist()
            sensor = self._sensors[s, i]
            truth = sensor.truth(senses.exposed[m], tick * self._tick_s)
            sensor.measure(truth, self._environment, values[m])
            noise = sensor.rng.standard_normal(sensor.noise_width)
            if read(sensor.width, values[m], senses.config[i, s], sensor.bias, senses.fault[i, s], noise):
                received.append(m)
        return senses.exposed_whose[received], values[received]


class _UserSensor:
    """A user's sensor of one drone: settings, current bias and random stream."""

    SAVED: ClassVar[Saved] = {"bias": IN_PLACE, "stream": list[int]}

    def __init__(
        self, label: str, kind: SensorType, settings: Sensor, rng: np.random.Generator, config: NDArray[np.float64]
    ) -> None:
        self._label, self._kind, self._settings, self.rng = label, kind, settings, rng
        self.width = kind.width
        models = kind.errors(settings)
        self.bias = np.zeros(2 * CHANNELS_MAX)
        self.bias[: self.width] = np.array([model.bias for model in models]) * rng.standard_normal(self.width)
        self.noise_width = noise_width(self.width, models)
        if self.noise_width > 2 * self.width + 1:
            sigma = np.array([model.correlated_sigma for model in models])
            self.bias[CHANNELS_MAX : CHANNELS_MAX + self.width] = sigma * rng.standard_normal(self.width)
        self._p_BS = config[CONFIG.p_BS : CONFIG.p_BS + 3].copy()
        self._R_BS = rotation_matrix(config[CONFIG.q_BS : CONFIG.q_BS + 4])

    @property
    def stream(self) -> list[int]:
        return words(self.rng)

    @stream.setter
    def stream(self, stream: list[int]) -> None:
        set_generator(self.rng, stream)

    def truth(self, row: NDArray[np.float64], t_s: float) -> SensorTruth:
        """Return the truth at a sampling time of the sensor, from a row of EXPOSED."""
        state, accel = row[EXPOSED.state : EXPOSED.accel].copy(), row[EXPOSED.accel : EXPOSED.air].copy()
        return SensorTruth(
            t_s=t_s,
            p_WB=state[STATE.p_WB : STATE.p_WB + 3],
            v_WB=state[STATE.v_WB : STATE.v_WB + 3],
            a_WB=accel[0:3],
            R_WB=rotation_matrix(state[STATE.q_WB : STATE.q_WB + 4]),
            w_WB_B=state[STATE.w_WB_B : STATE.w_WB_B + 3],
            alpha_B=accel[3:6],
            air_W=row[EXPOSED.air : EXPOSED.air + 3].copy(),
            p_BS=self._p_BS,
            R_BS=self._R_BS,
        )

    def measure(self, truth: SensorTruth, environment: object, values: NDArray[np.float64]) -> None:
        """Write the error-free values into `values`, (6,)."""
        assert self._kind.equation is not None  # the catalogue refuses user modules without an equation
        count = self._kind.values
        equation, where = self._kind.equation, f"{self._label} at {truth.t_s:.3f} s"
        name = f"{equation.__module__}:{getattr(equation, '__qualname__', type(equation).__qualname__)}"
        try:
            returned = equation(truth, self._settings, environment)
        except plugin.RAISED as error:
            failure = plugin.user_code_error(error, where)
            raise failure or UserCodeError(f"{name} raised {reason_of(error)}", where) from error
        try:
            values[:count] = np.reshape(plugin.numbers(returned), (count,))
        except ValueError as error:
            raise UserCodeError(f"{name} returns {show(returned)}; must be {count} numbers", where) from error
        if not np.isfinite(values).all():
            numbers = [float(value) for value in values[:count]]
            raise UserCodeError(f"{name} returns {numbers}; must be finite", where)


Array = NDArray[np.float64]


class Between(NamedTuple):
    """States of all drones at two gates, (N, STATE.size) each; the first arguments of `poses_between`."""

    former: Array
    former_ns: int
    now: Array
    now_ns: int


class Exposures:
    """The sampling times n / rate of several sensors, gate by gate."""

    SAVED: ClassVar[Saved] = {
        "_counts": list[int],
        "_due_ns": list[int],
        "_next_ns": int,
        "_former": np.ndarray,
        "_former_ns": int,
    }

    def __init__(self, rates_hz: Sequence[float], gate_ns: int) -> None:
        self._rates_hz, self._gate_ns = rates_hz, gate_ns
        self._counts = [0] * len(rates_hz)
        self._due_ns = [0] * len(rates_hz)  # time of each sensor's next sample
        self._next_ns = 0  # time of the next sample of any sensor
        self._former = np.empty((0, STATE.size))  # states at the last gate before the next sample
        self._former_ns = 0

    def until(self, state: Array, now_ns: int) -> tuple[list[tuple[int, int]], Between | None]:
        """Return the samples due by a gate and the states around them; without samples, an empty list and None.

        A sample is (time [ns], index of the sensor); samples are sorted by these.

        Args:
            state: states of all drones at the gate, (N, STATE.size or more).
            now_ns: time of the gate [ns].
        """
        due, between = [], None
        if self._next_ns <= now_ns:
            now = state[:, : STATE.size].copy()
            for index, rate_hz in enumerate(self._rates_hz):
                while self._due_ns[index] <= now_ns:
                    due.append((self._due_ns[index], index))
                    self._counts[index] += 1
                    self._due_ns[index] = round(self._counts[index] * 1e9 / rate_hz)
            due.sort()
            self._next_ns = min(self._due_ns)
            former, former_ns = (self._former, self._former_ns) if len(self._former) else (now, now_ns)
            between = Between(former, former_ns, now, now_ns)
        if self._next_ns <= now_ns + self._gate_ns:  # a sample due by the next gate needs this state
            self._former, self._former_ns = state[:, : STATE.size].copy(), now_ns
        return due, between


def released(later: list[Any], now_ns: int) -> list[Any]:
    """Remove the messages with a t_ns of at most `now_ns` from a list of delayed messages, and return them."""
    due = [each for each in later if each.t_ns <= now_ns]
    if due:
        later[:] = [each for each in later if each.t_ns > now_ns]
    return due


@kernel()
def poses_between(former: NDArray, former_ns: int, now: NDArray, now_ns: int, t_ns: int) -> NDArray:
    """Return the poses of all drones at t_ns between two gates, as rows like `former`.

    Args:
        former, now: states at the gates, (N, STATE.size or more); columns besides the pose are interpolated linearly.
        former_ns, now_ns: times of the gates [ns].
    """
    if t_ns >= now_ns or now_ns <= former_ns:
        return now.copy()
    s, dt = (t_ns - former_ns) / (now_ns - former_ns), (now_ns - former_ns) * 1e-9
    poses = former + s * (now - former)
    for i in range(len(poses)):
        a, b = former[i], now[i]
        p = position_between(
            s, dt, vector(a, STATE.p_WB), vector(a, STATE.v_WB), vector(b, STATE.p_WB), vector(b, STATE.v_WB)
        )
        q = attitude_between(s, four(a, STATE.q_WB), four(b, STATE.q_WB))
        for k in range(3):
            poses[i, STATE.p_WB + k] = p[k]
        for k in range(4):
            poses[i, STATE.q_WB + k] = q[k]
    return poses
