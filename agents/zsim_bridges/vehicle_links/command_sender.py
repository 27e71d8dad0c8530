"""Commands of a bridge to one drone, numbered per key."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

from zsim.contract import flight_messages, keys

ModeName = Literal["takeoff", "land", "emergency", "reset"]


class CommandSender:
    """Sends commands to a drone under the name of a process.

    Args:
        drone: its name.
        source: process name under which commands are sent.
        put: publishes a message on a key.

    Attributes:
        sent: commands so far.
    """

    def __init__(self, drone: str, source: str, put: Callable[[str, Any], None]) -> None:
        self._source = source
        self._put = put
        self._drone = drone
        self._seq: dict[str, int] = {}

    def mode(self, t_ns: int, mode: ModeName) -> None:
        """Take off, land, stop the rotors at once, or leave the emergency."""
        self._send("mode", flight_messages.Mode, t_ns, mode)

    def velocity(
        self,
        t_ns: int,
        velocity_m_s: Sequence[float],
        yaw_rate_rad_s: float,
        frame: Literal["heading", "world"] = "world",
    ) -> None:
        """Fly a velocity in W, or in the heading frame, and turn counter-clockwise."""
        x, y, z = velocity_m_s
        self._send("velocity", flight_messages.Velocity, t_ns, (x, y, z), yaw_rate_rad_s, frame)

    def tilt(self, t_ns: int, forward: float, left: float, up: float, yaw_left: float, hover: bool) -> None:
        """Fly as the AR.Drone's own commands do: shares of its limits in [-1, 1], or hover."""
        self._send("ardrone", flight_messages.Ardrone, t_ns, forward, left, up, yaw_left, hover)

    def attitude(self, t_ns: int, q_WB: Sequence[float], thrust_n: float, yaw_rate_rad_s: float) -> None:
        """Hold the tilt of an attitude with a thrust [N] and a yaw rate."""
        w, x, y, z = q_WB
        self._send("attitude", flight_messages.Attitude, t_ns, (w, x, y, z), thrust_n, yaw_rate_rad_s)

    @property
    def sent(self) -> int:
        return sum(self._seq.values())

    def _send(self, kind: str, message: Callable[..., Any], t_ns: int, *fields: Any) -> None:
        key = keys.command(self._drone, kind)
        seq = self._seq.get(key, 0)
        self._seq[key] = seq + 1
        self._put(key, message(t_ns, seq, self._source, *fields))
