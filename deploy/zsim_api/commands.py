"""Commands to drones, for `Simulation.step` and for agents: messages of the contract by their SI numbers.

The stamp, number and source of a command are filled in by whoever publishes it.
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from zsim.contract.flight_messages import Ardrone, Attitude, Mode, RotorSpeeds, Velocity
from zsim.errors import RunError

Command = Velocity | Attitude | RotorSpeeds | Ardrone | Mode
"""What a drone can be told: what the functions of this module return."""
_UNSTAMPED = (0, 0, "")  # t_ns, seq, source


def velocity(
    x_m_s: float,
    y_m_s: float,
    z_m_s: float,
    yaw_rate_rad_s: float = 0.0,
    frame: Literal["heading", "world"] = "heading",
) -> Velocity:
    """Return a command to fly a velocity: x forward, y left, z up; in the frame "world" east, north, up.

    Raises:
        RunError: a number is not finite, or the frame is unknown.
    """
    if frame not in ("heading", "world"):
        raise RunError(f"velocity: frame is {frame!r}; must be 'heading' or 'world'")
    *v, yaw_rate = _finite("velocity", (x_m_s, y_m_s, z_m_s, yaw_rate_rad_s))
    return Velocity(*_UNSTAMPED, (v[0], v[1], v[2]), yaw_rate, frame)


def attitude(orientation_wxyz: Sequence[float] | np.ndarray, thrust_n: float, yaw_rate_rad_s: float = 0.0) -> Attitude:
    """Return a command to fly a tilt: B to W, w first, its heading being ignored; with a thrust [N] and a yaw rate.

    Raises:
        RunError: a number is not finite, or the orientation does not have four.
    """
    *q, thrust, yaw_rate = _finite("attitude", (*orientation_wxyz, thrust_n, yaw_rate_rad_s))
    if len(q) != 4:
        raise RunError(f"attitude: orientation_wxyz has {len(q)} numbers; must have 4")
    return Attitude(*_UNSTAMPED, (q[0], q[1], q[2], q[3]), thrust, yaw_rate)


def rotors(speed_rad_s: Sequence[float] | np.ndarray) -> RotorSpeeds:
    """Return a command to turn the rotors at speeds (R,) [rad/s], in the order of `world/info`."""
    return RotorSpeeds(*_UNSTAMPED, _finite("rotors", speed_rad_s))


def ardrone(forward: float, left: float, up: float, yaw_left: float, hover: bool = False) -> Ardrone:
    """Return a command in the AR.Drone's terms: tilts, climb and yaw rate in [-1, 1] of their limits, or hovering."""
    return Ardrone(*_UNSTAMPED, *_finite("ardrone", (forward, left, up, yaw_left)), hover=hover)


def takeoff() -> Mode:
    """Return a command to take off, and to hover then."""
    return Mode(*_UNSTAMPED, "takeoff")


def land() -> Mode:
    """Return a command to land."""
    return Mode(*_UNSTAMPED, "land")


def emergency() -> Mode:
    """Return a command to stop the rotors at once."""
    return Mode(*_UNSTAMPED, "emergency")


def _finite(what: str, numbers: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    plain = tuple(map(float, numbers))
    if not all(map(math.isfinite, plain)):
        raise RunError(f"{what}: {', '.join(map(str, plain))} holds a number that is not finite; must be finite")
    return plain
