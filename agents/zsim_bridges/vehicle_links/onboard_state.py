"""The state of one aircraft as its own electronics know it: newest samples, attitude, altitude, odometry. Pure."""

import math
from collections import deque
from typing import Any

import msgspec
import numpy as np

from zsim.contract import flight_messages, messages
from zsim.math import frames as rotations
from zsim.math.rotation import LEVEL, Vector
from zsim.sensors.sensor import Mount
from zsim_agents.estimation.dead_reckoning import madgwick_step

BETA_RAD_S = 0.02  # of Madgwick's filter: levels within seconds, and is not led astray by a manoeuvre
UNIT_SLACK = 0.01  # of a quaternion's length; an estimator of positions alone may publish zeros
STEP_S_MAX = 0.1  # longer gaps in the IMU's samples are not integrated over
POSITIONS_KEPT = 32  # gates for which the integrated position is remembered; an estimate is some gates late at most


class OnboardState:
    """The state of one aircraft: newest sensor samples, attitude, altitude, odometry.

    The attitude is that of the drone's estimator; where there is none, that of Madgwick's filter on the drone's own
    IMU, whose heading is 0 where it begins, as that of the aircraft at power-on. The position is integrated from the
    optical flow.

    Args:
        imu: pose of the IMU in the body.
        mag: pose of the magnetometer.

    Attributes:
        imu, mag, baro, flow, status, estimate: newest, in the axes of the body; None before the first.
        attitude: B to W.
        altitude_m: over the ground, from the sonar; beyond its range, from the barometer since then.
        position_m: integrated since the start, with the altitude.
        origin_m: of the integrated position in W, by the estimator; None while there is no estimate.
    """

    def __init__(self, imu: Mount | None = None, mag: Mount | None = None) -> None:
        mounts = {messages.Imu: imu, messages.Mag: mag}
        self._q_BS = {
            kind: rotations.quaternion_from_rpy(np.radians(mount.rpy_deg))
            for kind, mount in mounts.items()
            if mount and any(mount.rpy_deg)
        }
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
        self._positions: deque[tuple[int, Vector]] = deque(maxlen=POSITIONS_KEPT)
        self.origin_m: Vector | None = None

    def update(self, message: Any) -> Any:
        """Update by a message of the drone or of its estimator; return it in the axes of the body."""
        q_BS = self._q_BS.get(type(message))
        message = message if q_BS is None else _rotated(message, q_BS)
        match message:
            case messages.Imu():
                self._on_imu(message)
            case messages.Mag():
                self.mag = message
            case messages.Baro():
                self._on_baro(message)
            case messages.Sonar():
                self._on_sonar(message)
            case messages.Flow():
                self._on_flow(message)
            case flight_messages.Estimate():
                self._on_estimate(message)
            case flight_messages.Status():
                self.status = message
                self._positions.append((message.t_ns, self.position_m))
        return message

    @property
    def position_m(self) -> Vector:
        return self._x_m, self._y_m, self.altitude_m

    def _on_imu(self, imu: messages.Imu) -> None:
        before, self.imu = self.imu, imu
        if self.estimate is None and before is not None:
            dt = (imu.t_sample_ns - before.t_sample_ns) * 1e-9
            if 0.0 < dt < STEP_S_MAX:
                self.attitude = madgwick_step(self.attitude, imu.gyro_rad_s, imu.accel_m_s2, BETA_RAD_S, dt)

    def _on_baro(self, baro: messages.Baro) -> None:
        self.baro = baro
        if self._ground_baro_m is not None:
            self.altitude_m = max(0.0, baro.altitude_m - self._ground_baro_m)

    def _on_sonar(self, sonar: messages.Sonar) -> None:
        if sonar.valid:
            self.altitude_m = sonar.range_m * max(0.0, float(rotations.rotation_matrix(self.attitude)[2, 2]))
            self._ground_baro_m = None
        elif self._ground_baro_m is None and self.baro is not None:
            self._ground_baro_m = self.baro.altitude_m - self.altitude_m

    def _on_flow(self, flow: messages.Flow) -> None:
        before, self.flow = self.flow, flow
        if before is None:
            return
        dt = (flow.t_sample_ns - before.t_sample_ns) * 1e-9
        yaw, (vx, vy, _) = float(rotations.heading(self.attitude)), flow.velocity_m_s
        self._x_m += dt * (vx * math.cos(yaw) - vy * math.sin(yaw))
        self._y_m += dt * (vx * math.sin(yaw) + vy * math.cos(yaw))

    def _on_estimate(self, estimate: flight_messages.Estimate) -> None:
        if abs(math.hypot(*estimate.orientation_wxyz) - 1.0) < UNIT_SLACK:
            self.estimate = estimate
            self.attitude = estimate.orientation_wxyz
        position = next((position for t_ns, position in self._positions if t_ns == estimate.t_ns), None)
        if position is not None:
            x, y, z = estimate.position_m
            self.origin_m = (x - position[0], y - position[1], z - position[2])


def warm_up() -> None:
    """Compile, or load, the kernels before the first gate."""
    madgwick_step(LEVEL, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8), BETA_RAD_S, STEP_S_MAX)


def _rotated(sample: Any, q_BS: np.ndarray) -> Any:
    """Return a sample of the IMU or the magnetometer with its vectors in the axes of the body."""
    names = [name for name in ("accel_m_s2", "gyro_rad_s", "field_ut") if hasattr(sample, name)]
    vectors = {name: tuple(rotations.rotate(q_BS, getattr(sample, name)).tolist()) for name in names}
    return msgspec.structs.replace(sample, **vectors)
