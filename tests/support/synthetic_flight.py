"""Flights with known truth and their sensor readings, independent of the simulated world, for tests of estimators."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from zsim.contract import messages
from zsim.math.randomness import stream
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.sensors.sensor import ErrorModel, Sensor, noise_sigma
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.estimator_bank import EstimatorBank

Array = NDArray[np.float64]

GATE_S = 0.02  # s
GRAVITY = np.array([0.0, 0.0, 9.80665])  # m/s^2, specific force on a body at rest
DRAG = 0.58  # 1/s: 0.249 N/(m/s) divided by 0.429 kg
STEP_S = 1e-3  # s, of central differences
GUST_S = 8.0  # s, time over which drift and wind build up
CLIMB_S = 20.0  # s, duration of the climb
HEIGHT_M = 15.0  # m, height after the climb


def scenario(preset: str = "paper", **sections: Any) -> Scenario:
    """Return a scenario of one drone, with `sensors`, `yaw_deg` and other sections set."""
    sensors = {"preset": preset, **sections.pop("sensors", {})}
    drone = {"name": "drone1", "position_m": [0.0, 0.0, 0.0], "yaw_deg": sections.pop("yaw_deg", 30.0)}
    return scenario_file.resolve(
        {"name": "synthetic", "duration_s": 60, "sensors": sensors, "drones": [drone], **sections}
    )


class Reading(NamedTuple):
    """A measurement of a sensor; `values` are in the order that `message` expects."""

    t_s: float
    sensor: str
    t_sample_s: float
    values: tuple[Any, ...]


def message(reading: Reading) -> Any:
    """Return a reading as its sensor's message."""
    stamps = (round(reading.t_s * 1e9), 0, round(reading.t_sample_s * 1e9))
    match reading.sensor:
        case "imu":
            return messages.Imu(*stamps, *reading.values)
        case "gps":
            position, velocity, sigma_m, fix = reading.values
            return messages.Gps(*stamps, 0.0, 0.0, 0.0, position, velocity, sigma_m, fix, 9)
        case "mag":
            return messages.Mag(*stamps, *reading.values)
        case "baro":
            return messages.Baro(*stamps, 0.0, *reading.values)
        case "sonar":
            return messages.Sonar(*stamps, *reading.values)
        case _:
            return messages.Flow(*stamps, *reading.values)


def seconds(t_s: float) -> float:
    """Return an instant [s] rounded to whole nanoseconds, as an estimator receives it."""
    return round(t_s * 1e9) * 1e-9


def feed(bank: EstimatorBank, i: int, reading: Reading) -> None:
    """Pass a reading of drone `i` to a bank."""
    bank.receive(i, reading.sensor, message(reading), seconds(reading.t_s))


class OneDrone:
    """The estimator of a scenario's first drone."""

    def __init__(self, of: Scenario) -> None:
        self.bank = EstimatorBank(of.drones[:1], of.environment, of.estimation, GATE_S)
        self.warm_start = partial(self.bank.warm_start, 0)

    def feed(self, reading: Reading) -> None:
        """Pass a reading to the estimator."""
        feed(self.bank, 0, reading)

    def close(self, t_s: float) -> StateEstimate:
        """Return the estimate at the end of a gate."""
        return self.bank.estimate(seconds(t_s))[0]


def estimator(of: Scenario) -> OneDrone:
    """Return the estimator of the scenario's drone."""
    return OneDrone(of)


class Flight:
    """A flight that stands at (1, 2, 0) m until `start_s`, then climbs to 15 m and drifts in sums of sines.

    Args:
        seed: seed of the drift and the steady wind.
        start_s: time of the start [s].
        yaw_rate: yaw rate in flight [rad/s].
        accel: standard deviation of the horizontal acceleration [m/s^2].
    """

    def __init__(self, seed: int, start_s: float = 5.0, yaw_rate: float = 0.1, accel: float = 0.3) -> None:
        rng = stream(seed, "flight")
        self.start_s, self.yaw_rate = start_s, yaw_rate
        self._w = 2.0 * math.pi * rng.uniform(0.05, 0.7, (3, 8))  # rad/s
        self._phase = rng.uniform(0.0, 2.0 * math.pi, (3, 8))
        self._size = accel * math.sqrt(2.0 / 8.0) / self._w**2 * np.array([[1.0], [1.0], [0.3]])
        self._wind = rng.standard_normal(3) * (0.5, 0.5, 0.2)
        self.yaw_start = rng.uniform(-math.pi, math.pi)

    def position(self, t: Array) -> Array:
        """p_WB (n, 3)."""
        begun, climbed = self._ramp(t, GUST_S), self._ramp(t, CLIMB_S)
        waves = (self._size * np.sin(self._w * t[:, None, None] + self._phase)).sum(2)
        return np.array([1.0, 2.0, 0.0]) + begun[:, None] * waves + HEIGHT_M * climbed[:, None] * (0.0, 0.0, 1.0)

    def velocity(self, t: Array) -> Array:
        """v_WB (n, 3)."""
        return (self.position(t + STEP_S) - self.position(t - STEP_S)) / (2.0 * STEP_S)

    def acceleration(self, t: Array) -> Array:
        """a_WB (n, 3)."""
        around = self.position(t + STEP_S) + self.position(t - STEP_S)
        return (around - 2.0 * self.position(t)) / STEP_S**2

    def attitude(self, t: Array) -> Array:
        """R_WB (n, 3, 3), whose z axis is along the thrust that balances acceleration, gravity and drag in the wind."""
        begun = self._ramp(t, GUST_S)[:, None]
        thrust = self.acceleration(t) + GRAVITY + begun * DRAG * (self.velocity(t) - self._wind)
        z = thrust / np.linalg.norm(thrust, axis=1)[:, None]
        yaw = self.yaw_start + self.yaw_rate * np.clip(t - self.start_s, 0.0, None) * self._ramp(t, GUST_S)
        y = np.cross(z, np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], 1))
        y /= np.linalg.norm(y, axis=1)[:, None]
        return np.stack([np.cross(y, z), y, z], 2)

    def rate(self, t: Array) -> Array:
        """w_WB_B (n, 3)."""
        turn = np.einsum("nji,njk->nik", self.attitude(t - STEP_S), self.attitude(t + STEP_S))
        return Rotation.from_matrix(turn).as_rotvec() / (2.0 * STEP_S)

    def heading(self, t: Array) -> Array:
        """Yaw (n,) [rad]."""
        R = self.attitude(t)
        return np.arctan2(R[:, 1, 0], R[:, 0, 0])

    def point(self, t: Array, p_BS: Array) -> tuple[Array, Array]:
        """Position and velocity of a point of the body in W, (n, 3) each."""
        R = self.attitude(t)
        swing = np.einsum("nij,nj->ni", R, np.cross(self.rate(t), p_BS))
        return self.position(t) + R @ p_BS, self.velocity(t) + swing

    def specific_force(self, t: Array, p_BS: Array) -> Array:
        """Specific force on an accelerometer at p_BS, in B (n, 3)."""
        w = self.rate(t)
        alpha = (self.rate(t + STEP_S) - self.rate(t - STEP_S)) / (2.0 * STEP_S)
        f = np.einsum("nji,nj->ni", self.attitude(t), self.acceleration(t) + GRAVITY)
        return f + np.cross(alpha, p_BS) + np.cross(w, np.cross(w, p_BS))

    def _ramp(self, t: Array, span_s: float) -> Array:
        """Rise from 0 to 1 over `span_s` from the start, three times differentiable."""
        u = np.clip((t - self.start_s) / span_s, 0.0, 1.0)
        return u**4 * (35.0 - 84.0 * u + 70.0 * u**2 - 20.0 * u**3)


class Circle(Flight):
    """A flight that stands until `start_s`, then climbs on a circle of 5 m at 2 m/s; arguments as for `Flight`."""

    RADIUS_M, SPEED_M_S, BEGIN_S = 5.0, 2.0, 4.0

    def position(self, t: Array) -> Array:
        u = np.clip(t - self.start_s, 0.0, None)
        x = np.clip(u / self.BEGIN_S, 0.0, 1.0)
        begun = self.BEGIN_S * (x**6 - 3.0 * x**5 + 2.5 * x**4)  # its derivative rises from 0 to 1
        angle = self.SPEED_M_S / self.RADIUS_M * np.where(u < self.BEGIN_S, begun, u - 0.5 * self.BEGIN_S)
        x, y = self.RADIUS_M * np.sin(angle), self.RADIUS_M * (1.0 - np.cos(angle))
        return np.stack([1.0 + x, 2.0 + y, HEIGHT_M * self._ramp(t, CLIMB_S)], 1)


def readings(flight: Flight, of: Scenario, seed: int, end_s: float) -> list[Reading]:
    """Return all readings up to `end_s` in the order in which they arrive."""
    found = [r for name in _READERS for r in _readings_of(name, flight, of, seed, end_s)]
    return sorted((r for r in found if r.t_s <= end_s), key=lambda r: r.t_s)


def fly(
    core: OneDrone, coming: Iterable[Reading], end_s: float, from_s: float = 0.0
) -> list[tuple[float, StateEstimate]]:
    """Feed an estimator gate by gate from `from_s` on; return time and estimate of each gate."""
    rest = [r for r in coming if r.t_s > from_s + 1e-9]
    estimates, k = [], 0
    for gate in range(round(from_s / GATE_S) + 1, round(end_s / GATE_S) + 1):
        t = gate * GATE_S
        while k < len(rest) and rest[k].t_s <= t + 1e-9:
            core.feed(rest[k])
            k += 1
        estimates.append((t, core.close(t)))
    return estimates


def _readings_of(name: str, flight: Flight, of: Scenario, seed: int, end_s: float) -> list[Reading]:
    sensor: Sensor = getattr(of.drones[0].sensors, name)
    t = np.arange(1, int(end_s * sensor.rate_hz) + 1) / sensor.rate_hz
    rng = stream(seed, f"synthetic/{name}")
    p_BS = np.array(sensor.mount.position_m)
    R_BS = Rotation.from_euler("ZYX", sensor.mount.rpy_deg[::-1], degrees=True).as_matrix()
    values = _READERS[name](flight, t, p_BS, R_BS, sensor, rng, np.array(of.environment.magnetic_field_ut))
    late = sensor.latency_ms * 1e-3
    return [Reading(a + late, name, a, v) for a, v in zip(t.tolist(), values, strict=True)]


def _noisy(truth: Array, error: ErrorModel, rate_hz: float, rng: np.random.Generator) -> list[Any]:
    """Return readings of a channel, (n, axes), with bias, bias walk, white and Gauss-Markov noise, and rounding."""
    bias = error.bias * rng.standard_normal(truth.shape[1])
    walk = error.bias_walk / math.sqrt(rate_hz) * np.cumsum(rng.standard_normal(truth.shape), 0)
    white = error.white_sigma(rate_hz) * rng.standard_normal(truth.shape)
    z = truth + bias + walk + white
    if error.correlated_sigma:
        decay, kicks = math.exp(-1.0 / rate_hz / error.correlation_time_s), rng.standard_normal(truth.shape)
        kicks[1:] *= math.sqrt(1.0 - decay**2)  # the first is drawn from the stationary distribution
        z += error.correlated_sigma * np.asarray(lfilter([1.0], [1.0, -decay], kicks, axis=0))
    return (z if error.quantum == 0.0 else np.round(z / error.quantum) * error.quantum).tolist()


def _imu(flight: Flight, t: Array, p_BS: Array, R_BS: Array, s: Any, rng: Any, field: Array) -> list[Any]:
    accel = _noisy(flight.specific_force(t, p_BS) @ R_BS, s.accel_m_s2, s.rate_hz, rng)
    gyro = _noisy(np.degrees(flight.rate(t) @ R_BS), s.gyro_deg_s, s.rate_hz, rng)
    return [(tuple(f), tuple(math.radians(x) for x in w)) for f, w in zip(accel, gyro, strict=True)]


def _gps(flight: Flight, t: Array, p_BS: Array, R_BS: Array, s: Any, rng: Any, field: Array) -> list[Any]:
    p, v = flight.point(t, p_BS)
    position = _noisy(p, s.position_m, s.rate_hz, rng)
    velocity = _noisy(v, s.velocity_m_s, s.rate_hz, rng)
    sigma_m = noise_sigma(s.position_m, s.rate_hz)
    return [(tuple(a), tuple(b), sigma_m, 3) for a, b in zip(position, velocity, strict=True)]


def _mag(flight: Flight, t: Array, p_BS: Array, R_BS: Array, s: Any, rng: Any, field: Array) -> list[Any]:
    seen = np.einsum("nji,j->ni", flight.attitude(t), field) @ R_BS
    return [(tuple(z),) for z in _noisy(seen, s.field_ut, s.rate_hz, rng)]


def _baro(flight: Flight, t: Array, p_BS: Array, R_BS: Array, s: Any, rng: Any, field: Array) -> list[Any]:
    return [(z[0],) for z in _noisy(flight.point(t, p_BS)[0][:, 2:], s.altitude_m, s.rate_hz, rng)]


def _sonar(flight: Flight, t: Array, p_BS: Array, R_BS: Array, s: Any, rng: Any, field: Array) -> list[Any]:
    down = -(flight.attitude(t) @ -R_BS[:, 2])[:, 2:]
    ranges = _noisy(flight.point(t, p_BS)[0][:, 2:] / down, s.range_m, s.rate_hz, rng)
    return [(z[0], s.min_m <= z[0] <= s.max_m) for z in ranges]


def _flow(flight: Flight, t: Array, p_BS: Array, R_BS: Array, s: Any, rng: Any, field: Array) -> list[Any]:
    v, yaw = flight.point(t, p_BS)[1], flight.heading(t)
    c, d = np.cos(yaw), np.sin(yaw)
    seen = np.stack([c * v[:, 0] + d * v[:, 1], c * v[:, 1] - d * v[:, 0], v[:, 2]], 1)
    return [(tuple(z), 1.0) for z in _noisy(seen, s.velocity_m_s, s.rate_hz, rng)]


_READERS: dict[str, Callable[..., list[Any]]] = {
    "imu": _imu, "gps": _gps, "mag": _mag, "baro": _baro, "sonar": _sonar, "flow": _flow,
}  # fmt: skip
