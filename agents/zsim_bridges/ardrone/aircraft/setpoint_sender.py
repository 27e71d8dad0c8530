"""A pilot's PCMD as what zsim's firmware takes: shares of its own limits, below a height, in the drone's frame."""

import math
from typing import NamedTuple

from zsim.vehicles.vehicle import Limits
from zsim_bridges.ardrone.aircraft.configuration import Configuration
from zsim_bridges.vehicle_links.command_sender import CommandSender

REPEAT_NS = 100_000_000  # ns; a commander that is silent for 0.5 s counts as dead, scenario `silence.hover_s`
NO_ALTITUDE_LIMIT_MM = 100_000  # altitude_max that means none (ARDroneLib)
CLIMB_1_S = 1.5  # 1/s, as the firmware nears its own greatest height
CALIBRATION_YAW_RAD_S = 1.0  # rad/s, chosen: a turn takes 6 s, as on the aircraft


class TiltSetpoint(NamedTuple):
    """A PCMD within its limits: shares of the largest tilt, climb and yaw rate.

    Attributes:
        hover: in place, whatever the shares are.
        right, back, up, clockwise: in [-1, 1].
        pilot_heading_rad: clockwise from north, where right and back are those of the pilot, not of the drone.
    """

    hover: bool
    right: float = 0.0
    back: float = 0.0
    up: float = 0.0
    clockwise: float = 0.0
    pilot_heading_rad: float | None = None


class SetpointSender:
    """Sends setpoints to one drone.

    Args:
        sender: of commands to it.
        limits: what zsim's shares of 1 mean.
        configuration: what the pilot's shares of 1 mean.

    Attributes:
        altitude_m: over the ground, to be kept.
        heading_rad: clockwise from magnetic north, to be kept.
        turn_ns: time of a whole turn of the calibration.
    """

    def __init__(self, sender: CommandSender, limits: Limits, configuration: Configuration) -> None:
        self._sender = sender
        self._configuration = configuration
        self._tilt_slope = math.tan(math.radians(limits.tilt_deg))
        self._climb_m_s, self._yaw_rad_s = limits.vertical_speed_m_s, math.radians(limits.yaw_rate_deg_s)
        self._turn_rad_s = min(CALIBRATION_YAW_RAD_S, self._yaw_rad_s)
        self.turn_ns = round(2e9 * math.pi / self._turn_rad_s)
        self.altitude_m = 0.0
        self.heading_rad = 0.0

    def repeat_ns(self, setpoint: TiltSetpoint) -> int:
        """Return after how long a setpoint is sent again: what depends on height or heading is, at every gate."""
        turns = setpoint.pilot_heading_rad is not None
        return 0 if turns or (setpoint.up > 0.0 and self._is_near_top()) else REPEAT_NS

    def send(self, t_ns: int, setpoint: TiltSetpoint) -> None:
        """Send a setpoint."""
        if setpoint.hover:
            self._sender.tilt(t_ns, 0.0, 0.0, 0.0, 0.0, hover=True)
        else:
            right, back = self._across(setpoint)
            self._sender.tilt(t_ns, -back, -right, self._up(setpoint), self._yaw_left(setpoint), hover=False)

    def send_turn(self, t_ns: int) -> None:
        """Let the drone turn clockwise, in place."""
        self._sender.velocity(t_ns, (0.0, 0.0, 0.0), -self._turn_rad_s)

    def _is_near_top(self) -> bool:
        return self._climb_left_m_s() < self._configuration.number("control:control_vz_max") / 1e3

    def _climb_left_m_s(self) -> float:
        """Return how fast it may climb below altitude_max."""
        highest_mm = self._configuration.number("control:altitude_max")
        if highest_mm >= NO_ALTITUDE_LIMIT_MM:
            return math.inf
        return CLIMB_1_S * (highest_mm / 1e3 - self.altitude_m)

    def _across(self, setpoint: TiltSetpoint) -> tuple[float, float]:
        """Return the shares of zsim's tilt to the drone's right and back."""
        right, back = setpoint.right, setpoint.back
        if setpoint.pilot_heading_rad is not None:
            turn = setpoint.pilot_heading_rad - self.heading_rad
            sine, cosine = math.sin(turn), math.cos(turn)
            right, back = cosine * right - sine * back, sine * right + cosine * back
        tilt_rad = self._configuration.number("control:euler_angle_max")
        return self._tilt_share(right * tilt_rad), self._tilt_share(back * tilt_rad)

    def _tilt_share(self, tilt_rad: float) -> float:
        return share(math.tan(tilt_rad) / self._tilt_slope)

    def _up(self, setpoint: TiltSetpoint) -> float:
        climb_m_s = setpoint.up * self._configuration.number("control:control_vz_max") / 1e3
        return share(min(climb_m_s, self._climb_left_m_s()) / self._climb_m_s)

    def _yaw_left(self, setpoint: TiltSetpoint) -> float:
        return share(-setpoint.clockwise * self._configuration.number("control:control_yaw") / self._yaw_rad_s)


def share(value: float) -> float:
    """Return a share of a limit, cut to [-1, 1]."""
    return min(1.0, max(-1.0, value))
