"""Control of drones from Python: commands, and requests to the pilot of a drone that flies a reference.

Commands are passed to `Simulation.step` or sent by agents; they are messages of the contract in SI units, whose time,
sequence number and source the publisher fills in. Requests go to a drone that flies on its own:
`sim.drone("drone1").goto((1, 2, 3))`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from zsim.contract import keys
from zsim.contract.flight_messages import Ardrone, Attitude, Mode, RotorSpeeds, Velocity
from zsim.errors import RunError

Command = Velocity | Attitude | RotorSpeeds | Ardrone | Mode
"""A command to a drone, as returned by the functions of this module."""
_UNSTAMPED = (0, 0, "")  # t_ns, seq, source
Ask = Callable[..., dict[str, Any]]
"""The method `ask` of a `Simulation` or a `Federation`: takes key, op and arguments; raises RequestRefusedError."""


def velocity(
    x_m_s: float,
    y_m_s: float,
    z_m_s: float,
    yaw_rate_rad_s: float = 0.0,
    frame: Literal["heading", "world"] = "heading",
) -> Velocity:
    """Return a command to fly at a velocity [m/s]: x forward, y left, z up; in the frame "world" east, north, up.

    Raises:
        RunError: a number is not finite, or the frame is unknown.
    """
    if frame not in ("heading", "world"):
        raise RunError(f"velocity: frame is {frame!r}; must be 'heading' or 'world'")
    *v, yaw_rate = _finite("velocity", (x_m_s, y_m_s, z_m_s, yaw_rate_rad_s))
    return Velocity(*_UNSTAMPED, (v[0], v[1], v[2]), yaw_rate, frame)


def attitude(orientation_wxyz: Sequence[float] | np.ndarray, thrust_n: float, yaw_rate_rad_s: float = 0.0) -> Attitude:
    """Return a command to hold a tilt (B to W, w first; heading ignored), a thrust [N] and a yaw rate [rad/s].

    Raises:
        RunError: a number is not finite, or the orientation does not have four numbers.
    """
    *q, thrust, yaw_rate = _finite("attitude", (*orientation_wxyz, thrust_n, yaw_rate_rad_s))
    if len(q) != 4:
        raise RunError(f"attitude: orientation_wxyz has {len(q)} numbers; must have 4")
    return Attitude(*_UNSTAMPED, (q[0], q[1], q[2], q[3]), thrust, yaw_rate)


def rotors(speed_rad_s: Sequence[float] | np.ndarray) -> RotorSpeeds:
    """Return a command to turn the rotors at speeds (R,) [rad/s], in the order of `world/info`."""
    return RotorSpeeds(*_UNSTAMPED, _finite("rotors", speed_rad_s))


def ardrone(forward: float, left: float, up: float, yaw_left: float, hover: bool = False) -> Ardrone:
    """Return an AR.Drone command: tilts, climb and yaw rate in [-1, 1], scaled to their limits, or hover."""
    return Ardrone(*_UNSTAMPED, *_finite("ardrone", (forward, left, up, yaw_left)), hover=hover)


def takeoff() -> Mode:
    """Return a command to take off, then hover."""
    return Mode(*_UNSTAMPED, "takeoff")


def land() -> Mode:
    """Return a command to land."""
    return Mode(*_UNSTAMPED, "land")


def emergency() -> Mode:
    """Return a command to stop the rotors at once."""
    return Mode(*_UNSTAMPED, "emergency")


def _finite(name: str, numbers: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    values = tuple(map(float, numbers))
    if not all(map(math.isfinite, values)):
        raise RunError(f"{name}: {', '.join(map(str, values))} holds a number that is not finite; must be finite")
    return values


class PilotedDrone:
    """The requests to the pilot of one drone; see docs/references.md.

    Each request acts from the next gate on. It raises RequestRefusedError if, for example, the drone has no `reference`
    in the scenario, is not in the air, or cannot fly the requested path.

    Attributes:
        name: name of the drone.
    """

    def __init__(self, name: str, ask: Ask) -> None:
        self.name = name
        self._ask, self._key = ask, keys.drone_control(name)

    def goto(
        self,
        position_m: Sequence[float] | Sequence[Sequence[float]] | np.ndarray,
        yaw_deg: float | None = None,
        over_s: float | None = None,
        *,
        speed_m_s: float | None = None,
        radius_m: float | None = None,
    ) -> float:
        """Fly to a position in W, or through several, and rest at the last; return the simulated time of arrival [s].

        Args:
            position_m: (3,), or (n, 3) for successive positions.
            yaw_deg: heading there; None: the present heading.
            over_s: duration of a flight to one position, which is lengthened if the drone's limits require it. With the
                same duration, all drones follow the same function of time.
            speed_m_s: cruise speed; None, or beyond the drone's limits: as fast as these allow.
            radius_m: distance from a position within which the drone turns towards the next one; None or 0: it rests at
                each position.
        """
        positions_m = np.asarray(position_m, float)
        field = "places_m" if positions_m.ndim == 2 else "position_m"
        options = {"yaw_deg": yaw_deg, "over_s": over_s, "speed_m_s": speed_m_s, "radius_m": radius_m}
        args = {field: positions_m.tolist(), **{name: value for name, value in options.items() if value is not None}}
        return float(self._ask(self._key, "goto", **args)["until_s"])

    def follow(self, **path: Any) -> float | None:
        """Fly to the start of a path, then along it; return the simulated time of its end [s], None if it has no end.

        Args:
            path: fields of a reference as in a scenario, except its times, gains and file:
                `minimum_snap=[{"at_s": 0, "position_m": [0, 0, 2]}, …]`,
                `circle={"radius_m": 2, "period_s": 10}`, `fit=True`, `origin_m=…`.
        """
        return self._ask(self._key, "follow", **path)["until_s"]

    def hold(self) -> None:
        """Come to rest."""
        self._ask(self._key, "hold")

    def land(self) -> None:
        """Land at the current position."""
        self._ask(self._key, "land")

    def takeoff(self) -> None:
        """Take off again after a landing."""
        self._ask(self._key, "takeoff")

    def __repr__(self) -> str:
        return f"<PilotedDrone {self.name}>"
