"""The state that ardrone_autonomy's driver reports: newest sensor samples, attitude, altitude, odometry. Pure.

Attitude is that of the drone's estimator; where there is none, Madgwick's filter on the drone's own IMU, whose heading
is 0 where it begins, as that of the aircraft at power-on. Position is integrated from the optical flow.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar

import msgspec

from zsim.contract import messages
from zsim.sensors.sensor import Mount
from zsim_agents.estimation.madgwick import LEVEL, Rotation, madgwick_step, rpy_rotation, turn
from zsim_bridges import ros_frames
from zsim_bridges.ros_frames import Vector

BETA_RAD_S = 0.02  # of Madgwick's filter: levels within seconds, and is not led astray by a manoeuvre
UNIT_SLACK = 0.01  # of a quaternion's length; an estimator of positions alone may publish zeros
STEP_S_MAX = 0.1  # longer gaps in the IMU's samples are not integrated over
_VECTORS = ("accel_m_s2", "gyro_rad_s", "field_ut")  # of samples in the axes of a sensor
POSITIONS_KEPT = 32  # gates for which the integrated position is remembered; an estimate is some gates late at most


class OnboardState:
    """One aircraft.

    Args:
        imu: pose of the IMU in the body.
        mag: pose of the magnetometer.

    Attributes:
        imu, mag, baro, flow, status, estimate: newest, in the axes of the body; None before the first.
        attitude: B to W.
        altitude_m: over the ground, from the sonar; beyond its range, from the barometer since then.
        position_m: integrated since the start, with the altitude.
    """

    def __init__(self, imu: Mount | None = None, mag: Mount | None = None) -> None:
        mounts = {messages.Imu: imu, messages.Mag: mag}
        self._rotations = {
            kind: rpy_rotation(mount.rpy_deg) for kind, mount in mounts.items() if mount and any(mount.rpy_deg)
        }
        self.imu: messages.Imu | None = None
        self.mag: messages.Mag | None = None
        self.baro: messages.Baro | None = None
        self.flow: messages.Flow | None = None
        self.status: messages.Status | None = None
        self.estimate: messages.Estimate | None = None
        self.attitude = LEVEL
        self.altitude_m = 0.0
        self._ground_baro_m: float | None = None
        self._x_m = self._y_m = 0.0
        self._positions: deque[tuple[int, Vector]] = deque(maxlen=POSITIONS_KEPT)
        self.origin_m: Vector | None = None

    def update(self, message: Any) -> Any:
        """Update by a message of the drone or of its estimator; return it in the axes of the body."""
        R_BS = self._rotations.get(type(message))
        message = message if R_BS is None else _rotated(message, R_BS)
        handler = self._HANDLERS.get(type(message))
        if handler is not None:
            handler(self, message)
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

    def _on_mag(self, mag: messages.Mag) -> None:
        self.mag = mag

    def _on_baro(self, baro: messages.Baro) -> None:
        self.baro = baro
        if self._ground_baro_m is not None:
            self.altitude_m = max(0.0, baro.altitude_m - self._ground_baro_m)

    def _on_sonar(self, sonar: messages.Sonar) -> None:
        if sonar.valid:
            self.altitude_m = sonar.range_m * max(0.0, ros_frames.tilt_cosine(self.attitude))
            self._ground_baro_m = None
        elif self._ground_baro_m is None and self.baro is not None:
            self._ground_baro_m = self.baro.altitude_m - self.altitude_m

    def _on_flow(self, flow: messages.Flow) -> None:
        before, self.flow = self.flow, flow
        if before is None:
            return
        dt = (flow.t_sample_ns - before.t_sample_ns) * 1e-9
        yaw, (vx, vy, _) = ros_frames.yaw(self.attitude), flow.velocity_m_s
        self._x_m += dt * (vx * math.cos(yaw) - vy * math.sin(yaw))
        self._y_m += dt * (vx * math.sin(yaw) + vy * math.cos(yaw))

    def _on_estimate(self, estimate: messages.Estimate) -> None:
        if abs(math.hypot(*estimate.orientation_wxyz) - 1.0) < UNIT_SLACK:
            self.estimate = estimate
            self.attitude = estimate.orientation_wxyz
        position = next((position for t_ns, position in self._positions if t_ns == estimate.t_ns), None)
        if position is not None:
            x, y, z = estimate.position_m
            self.origin_m = (x - position[0], y - position[1], z - position[2])

    def _on_status(self, status: messages.Status) -> None:
        self.status = status
        self._positions.append((status.t_ns, self.position_m))

    _HANDLERS: ClassVar[dict[type, Callable[["OnboardState", Any], None]]] = {
        messages.Imu: _on_imu,
        messages.Mag: _on_mag,
        messages.Baro: _on_baro,
        messages.Sonar: _on_sonar,
        messages.Flow: _on_flow,
        messages.Estimate: _on_estimate,
        messages.Status: _on_status,
    }


def warm_up() -> None:
    """Compile, or load, the kernels before the first gate."""
    madgwick_step(LEVEL, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8), BETA_RAD_S, STEP_S_MAX)


def _rotated(sample: Any, R_BS: Rotation) -> Any:
    """Return a sample with its vectors in the axes of the body."""
    vectors = {name: turn(R_BS, getattr(sample, name)) for name in _VECTORS if hasattr(sample, name)}
    return msgspec.structs.replace(sample, **vectors)
