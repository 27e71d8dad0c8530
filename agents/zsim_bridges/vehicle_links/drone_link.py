"""A bridge's link to one drone: the commands sent to it, and the state known to its onboard electronics. No I/O."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal

import msgspec
import numpy as np

from zsim.contract import flight_messages, keys, messages
from zsim.math import frames as rotations
from zsim.math.rotation import LEVEL, Vector
from zsim.sensors.sensor import Mount
from zsim_agents.estimation.strapdown import madgwick_step

BETA_RAD_S = 0.02  # gain of Madgwick's filter, with which it levels within seconds and manoeuvres hardly disturb it
REPEAT_NS = 100_000_000  # period of repeated setpoints: a commander is lost after 0.5 s of silence (`silence.hover_s`)
STEP_S_MAX = 0.1  # s; the filter does not integrate over longer gaps between IMU samples
POSITIONS_MAX = 32  # gates for which the integrated position is remembered; an estimate is at most a few gates late
ModeName = Literal["takeoff", "land", "emergency", "reset"]


class CommandSender:
    """Sends a drone commands in the name of a process; they are numbered separately for each key."""

    def __init__(self, drone: str, source: str, put: Callable[[str, Any], None]) -> None:
        self._source = source
        self._put = put
        self._drone = drone
        self._seq: dict[str, int] = {}

    def send_mode(self, t_ns: int, mode: ModeName) -> None:
        self._send("mode", flight_messages.Mode, t_ns, mode)

    def send_velocity(
        self,
        t_ns: int,
        velocity_m_s: Sequence[float],
        yaw_rate_rad_s: float,
        frame: Literal["heading", "world"] = "world",
    ) -> None:
        """Command a velocity in W or in the heading frame, and a counter-clockwise yaw rate."""
        x, y, z = velocity_m_s
        self._send("velocity", flight_messages.Velocity, t_ns, (x, y, z), yaw_rate_rad_s, frame)

    def send_tilt(self, t_ns: int, forward: float, left: float, up: float, yaw_left: float, hover: bool) -> None:
        """Command the drone as an AR.Drone: by fractions of its limits in [-1, 1], or to hover."""
        self._send("ardrone", flight_messages.Ardrone, t_ns, forward, left, up, yaw_left, hover)

    def send_attitude(self, t_ns: int, q_WB: Sequence[float], thrust_n: float, yaw_rate_rad_s: float) -> None:
        """Command the tilt of an attitude, a thrust [N] and a yaw rate."""
        w, x, y, z = q_WB
        self._send("attitude", flight_messages.Attitude, t_ns, (w, x, y, z), thrust_n, yaw_rate_rad_s)

    def _send(self, kind: str, message: Callable[..., Any], t_ns: int, *fields: Any) -> None:
        key = keys.command(self._drone, kind)
        seq = self._seq.get(key, 0)
        self._seq[key] = seq + 1
        self._put(key, message(t_ns, seq, self._source, *fields))


class BodyAxes:
    """Converts samples of the IMU and the magnetometer, whose poses in the body are given, to body axes."""

    def __init__(self, imu: Mount | None = None, mag: Mount | None = None) -> None:
        mounts = {messages.Imu: imu, messages.Mag: mag}
        self._q_BS = {
            kind: rotations.quaternion_from_rpy(np.radians(mount.rpy_deg))
            for kind, mount in mounts.items()
            if mount and any(mount.rpy_deg)
        }

    def converted(self, message: Any) -> Any:
        """Return a sample in body axes; any other message unchanged."""
        q_BS = self._q_BS.get(type(message))
        if q_BS is None:
            return message
        names = [name for name in ("accel_m_s2", "gyro_rad_s", "field_ut") if hasattr(message, name)]
        vectors = {name: tuple(rotations.rotate(q_BS, getattr(message, name)).tolist()) for name in names}
        return msgspec.structs.replace(message, **vectors)


class OnboardState:
    """The state of one aircraft: newest sensor samples, attitude, altitude, odometry.

    The attitude is that of the drone's estimator or, if none runs, of Madgwick's filter on the drone's own IMU, whose
    heading is 0 at the start, like that of the aircraft at power-on. The position is integrated from the optical flow.
    The arguments are the poses of the IMU and the magnetometer in the body.

    Attributes:
        imu, mag, baro, flow, status: newest message of each kind, in body axes; None before the first.
        estimate: newest estimate that has an attitude; None before the first.
        attitude: B to W.
        altitude_m: height above ground, from the sonar; beyond its range, continued by the barometer.
        position_m: horizontal position integrated since the start, and the altitude.
        origin_m: origin of the integrated position in W, according to the estimator; None without an estimate.
    """

    def __init__(self, imu: Mount | None = None, mag: Mount | None = None) -> None:
        self._axes = BodyAxes(imu, mag)
        self.imu: messages.Imu | None = None
        self.mag: messages.Mag | None = None
        self.baro: messages.Baro | None = None
        self.flow: messages.Flow | None = None
        self.status: flight_messages.Status | None = None
        self.estimate: flight_messages.Estimate | None = None
        self.attitude = LEVEL
        self.altitude_m = 0.0
        self._ground_baro_m: float | None = None
        self._x_m = self._y_m = 0.0
        self._positions: deque[tuple[int, Vector]] = deque(maxlen=POSITIONS_MAX)
        self.origin_m: Vector | None = None

    def update(self, message: Any) -> Any:
        """Process a message of the drone or of its estimator; return it in body axes."""
        message = self._axes.converted(message)
        match message:
            case messages.Imu():
                previous, self.imu = self.imu, message
                if self.estimate is None and previous is not None:
                    dt = (message.t_sample_ns - previous.t_sample_ns) * 1e-9
                    if 0.0 < dt < STEP_S_MAX:
                        rate, force = message.gyro_rad_s, message.accel_m_s2
                        self.attitude = madgwick_step(self.attitude, rate, force, BETA_RAD_S, dt)
            case messages.Mag():
                self.mag = message
            case messages.Baro():
                self.baro = message
                if self._ground_baro_m is not None:
                    self.altitude_m = max(0.0, message.altitude_m - self._ground_baro_m)
            case messages.Sonar(valid=True):
                cosine = float(rotations.rotation_matrix(self.attitude)[2, 2])
                self.altitude_m = message.range_m * max(0.0, cosine)
                self._ground_baro_m = None
            case messages.Sonar():
                if self._ground_baro_m is None and self.baro is not None:
                    self._ground_baro_m = self.baro.altitude_m - self.altitude_m
            case messages.Flow():
                previous, self.flow = self.flow, message
                if previous is not None:
                    dt = (message.t_sample_ns - previous.t_sample_ns) * 1e-9
                    yaw = float(rotations.heading(self.attitude))
                    vx, vy, _ = rotations.turned_about_up(message.velocity_m_s, yaw)
                    self._x_m += dt * vx
                    self._y_m += dt * vy
            case flight_messages.Estimate():
                if has_attitude(message):
                    self.estimate = message
                    self.attitude = message.orientation_wxyz
                position = next((position for t_ns, position in self._positions if t_ns == message.t_ns), None)
                if position is not None:
                    x, y, z = message.position_m
                    self.origin_m = (x - position[0], y - position[1], z - position[2])
            case flight_messages.Status():
                self.status = message
                self._positions.append((message.t_ns, self.position_m))
        return message

    @property
    def position_m(self) -> Vector:
        return self._x_m, self._y_m, self.altitude_m


def has_attitude(estimate: flight_messages.Estimate) -> bool:
    """Return whether an estimate has an attitude; an estimator of positions alone may publish zeros."""
    return abs(math.hypot(*estimate.orientation_wxyz) - 1.0) <= flight_messages.UNIT_SLACK


def warm_up() -> None:
    """Compile or load the kernels before the first gate, which would otherwise wait for this."""
    madgwick_step(LEVEL, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8), BETA_RAD_S, STEP_S_MAX)
