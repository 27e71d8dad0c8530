"""The state of a vehicle, estimated or, without an estimator, true; the health of its sensors; and targets for it."""

import math
from typing import Any, NamedTuple

import numpy as np

from zsim.contract import flight_messages, messages
from zsim.contract.messages import Origin
from zsim.math import elementary as el
from zsim.math import frames
from zsim.math.frames import anchor, geodetic
from zsim.math.rotation import LEVEL, Quaternion, Vector
from zsim.scenario.scenario import Drone
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import SensorBit
from zsim_bridges.vehicle_links.drone_link import BodyAxes, has_attitude

ESTIMATE_AGE_MAX_NS = 500_000_000  # ns; an older estimate is not used
MISSED_SAMPLES_MAX = 5  # periods without a sample after which a sensor is considered failed
LOW_BATTERY_PERCENT = 20.0  # above BAT_CRIT_THR and the like, so that the pilot is warned before these act
AIRBORNE_STATES = ("taking_off", "hovering", "flying", "landing")
SENSORS = {
    "imu": SensorBit.GYRO | SensorBit.ACCEL,
    "mag": SensorBit.MAG,
    "baro": SensorBit.BARO,
    "gps": SensorBit.GPS,
    "sonar": SensorBit.LASER_POSITION,
    "flow": SensorBit.FLOW,
}
ALL_HEALTHY = SensorBit(sum(SensorBit))
POSITION_MAX_M = 1e6  # m; positions beyond this are refused
Axes = tuple[float | None, float | None, float | None]
NO_POSITION: Axes = (None, None, None)


class VehicleState:
    """The state of one vehicle.

    Attributes:
        t_ns: simulated time of the newest status.
        position_m, velocity_m_s: in W; q_WB, rate_rad_s: attitude, and angular rate in body axes.
        is_estimated: whether position, velocity and attitude are the estimator's.
        sigma_m: standard deviations of the horizontal and the vertical position; 0 for the truth.
        samples: newest sample of each sensor, by name; those of the IMU and the magnetometer in body axes.
        home_m: home in W, initially where the vehicle was switched on; None before it is known.
    """

    def __init__(self, drone: Drone, origin: Origin) -> None:
        self.t_ns = self._first_ns = 0
        self.status: flight_messages.Status | None = None
        self.position_m: Vector = drone.position_m
        self.velocity_m_s: Vector = (0.0, 0.0, 0.0)
        self.rate_rad_s: Vector = (0.0, 0.0, 0.0)
        self.q_WB = LEVEL
        self.is_estimated = False
        self.sigma_m = (0.0, 0.0)
        self.samples: dict[str, Any] = {}
        self._axes = BodyAxes(drone.sensors.imu.mount, drone.sensors.mag.mount)
        self._new_samples: dict[str, list[Any]] = {}
        self.home_m: Vector | None = None
        self.origin = (origin.latitude_deg, origin.longitude_deg, origin.height_m)
        self._anchor = anchor(*self.origin)
        self._estimate_ns = -ESTIMATE_AGE_MAX_NS - 1
        self._silence_max_ns = {
            name: round(1e9 * MISSED_SAMPLES_MAX / getattr(drone.sensors, name).rate_hz) for name in SENSORS
        }

    def update(self, name: str, message: Any) -> None:
        """Process a message of the drone or of its estimator; `name` is the last part of its key."""
        match message:
            case flight_messages.Status():
                if self.status is None:
                    self._first_ns = message.t_ns
                self.status, self.t_ns = message, message.t_ns
                if self.home_m is None:
                    self.home_m = self.position_m
            case flight_messages.Truth():
                if message.t_ns - self._estimate_ns > ESTIMATE_AGE_MAX_NS:
                    self.is_estimated, self.sigma_m = False, (0.0, 0.0)
                    self.position_m, self.velocity_m_s = message.position_m, message.velocity_m_s
                    self.q_WB = message.orientation_wxyz
            case flight_messages.Estimate():
                if has_attitude(message):
                    self._estimate_ns, self.is_estimated = message.t_ns, True
                    self.position_m, self.velocity_m_s = message.position_m, message.velocity_m_s
                    self.q_WB = message.orientation_wxyz
                    variances = message.covariance
                    horizontal, vertical = max(0.0, variances[0] + variances[7]), max(0.0, variances[14])
                    self.sigma_m = math.sqrt(horizontal / 2.0), math.sqrt(vertical)
            case _:
                message = self._axes.converted(message)
                self.samples[name] = message
                self._new_samples.setdefault(name, []).append(message)
                if isinstance(message, messages.Imu):
                    self.rate_rad_s = message.gyro_rad_s

    def take_new_samples(self) -> dict[str, list[Any]]:
        samples, self._new_samples = self._new_samples, {}
        return samples

    @property
    def is_airborne(self) -> bool:
        return self.status is not None and self.status.state in AIRBORNE_STATES

    @property
    def is_steerable(self) -> bool:
        """Whether the firmware accepts setpoints."""
        return self.status is not None and self.status.state in flight_messages.AIRBORNE

    @property
    def state(self) -> str:
        return self.status.state if self.status else "landed"

    @property
    def yaw_rad(self) -> float:
        """Yaw counter-clockwise from east."""
        return float(frames.heading(self.q_WB))

    @property
    def is_battery_low(self) -> bool:
        return self.status is not None and self.status.battery_percent < LOW_BATTERY_PERCENT

    def has_failed(self, sensor: str) -> bool:
        sample = self.samples.get(sensor)
        return self.t_ns - (sample.t_ns if sample else self._first_ns) > self._silence_max_ns[sensor]

    def failed_sensors(self) -> list[str]:
        return [name for name in SENSORS if self.has_failed(name)]

    def health(self) -> SensorBit:
        healthy = ALL_HEALTHY
        for name in self.failed_sensors():
            healthy &= ~SENSORS[name]
        if self.is_battery_low:
            healthy &= ~SensorBit.BATTERY
        if self.state == "emergency":
            healthy &= ~SensorBit.PREARM_CHECK
        return healthy

    def to_global(self, position_m: Vector) -> Vector:
        """Return latitude [deg], longitude [deg] and ellipsoidal height [m] of a point in W."""
        (geodetic_point,) = geodetic(np.array([position_m]), *self._anchor).tolist()
        return geodetic_point[0], geodetic_point[1], geodetic_point[2]

    def to_local(self, latitude_deg: float, longitude_deg: float, height_m: float) -> Vector:
        """Return the position in W [m] of a geodetic point."""
        x, y, z = frames.geodetic_to_enu((latitude_deg, longitude_deg, height_m), self.origin).tolist()
        return x, y, z

    @property
    def home_or_current_m(self) -> Vector:
        """Home in W; the current position until home is known."""
        return self.home_m or self.position_m

    @property
    def altitude_m(self) -> float:
        """Height above home."""
        return self.position_m[2] - self.home_or_current_m[2]

    @property
    def rpy_ned_rad(self) -> Vector:
        """Roll, pitch and yaw in MAVLink's axes."""
        roll, pitch, yaw = frames.rpy_from_quaternion(dialect.attitude_ned(self.q_WB)).tolist()
        return roll, pitch, yaw


class Target(NamedTuple):
    """A position or velocity to be held.

    Attributes:
        position_m: position in W; None in axes in which only the velocity counts.
        velocity_m_s: velocity added to the one towards the position.
        yaw_rad: counter-clockwise from east; None to turn at `yaw_rate_rad_s`.
        yaw_rate_rad_s: counter-clockwise.
        along_heading: whether the velocity is forward, left, up rather than in W.
        speed_m_s: limit of the horizontal speed; None for the vehicle's own.
    """

    position_m: Axes = NO_POSITION
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    yaw_rad: float | None = None
    yaw_rate_rad_s: float = 0.0
    along_heading: bool = False
    speed_m_s: float | None = None

    def distance_m(self, position_m: Vector) -> float:
        pairs = zip(self.position_m, position_m, strict=True)
        return el.length((0.0 if p is None else p - current for p, current in pairs))


class TiltTarget(NamedTuple):
    """A tilt to be held: attitude B to W, thrust [N], and yaw rate [rad/s] counter-clockwise."""

    q_WB: Quaternion
    thrust_n: float
    yaw_rate_rad_s: float


def is_valid_position(position_m: Axes) -> bool:
    return all(p is None or (math.isfinite(p) and abs(p) < POSITION_MAX_M) for p in position_m)
