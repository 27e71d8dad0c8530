"""Commands and requests of ROS nodes to drones and clusters, published on the keys of the contract."""

import math
from threading import Lock
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Mode, Velocity
from zsim.errors import DecodeError
from zsim.transport.session import Session
from zsim_bridges.observer_process import ObserverProcess

STATUS_S = 1.0  # how long a drone's state is waited for


class RosCommands:
    """Sends commands in the bridge's name; called in several threads.

    Args:
        link: to the world.
        observer: for the name, and the time of the newest gate.
        response: class of std_srvs/Trigger_Response.
    """

    def __init__(self, link: Session, observer: ObserverProcess, response: Any) -> None:
        self._link = link
        self._observer = observer
        self._response = response
        self._seq: dict[str, int] = {}
        self._lock = Lock()

    def send_velocity(self, drone: str, twist: Any) -> None:
        """Fly a Twist: forward, left, up [m/s] in the heading frame, and counter-clockwise [rad/s].

        Raises:
            ValueError: a number is not finite.
        """
        linear, turn = twist.linear, twist.angular.z
        v = float(linear.x), float(linear.y), float(linear.z)
        if not all(map(math.isfinite, (*v, turn))):
            raise ValueError(f"the velocity is {(*v, turn)}; must be finite")
        key = keys.command(drone, "velocity")
        with self._lock:
            self._link.put(key, Velocity(*self._next_stamp(key), self._observer.name, v, float(turn)))

    def send_mode(self, drone: str, mode: Any) -> None:
        """Let a drone take off, land, stop at once or leave the emergency."""
        key = keys.command(drone, "mode")
        with self._lock:
            self._link.put(key, Mode(*self._next_stamp(key), self._observer.name, mode))

    def toggle_emergency(self, drone: str) -> None:
        """Stop the rotors at once, or, where that has happened, make ready to fly: the aircraft's emergency button.

        Raises:
            ValueError: the drone's state is not known.
        """
        self.send_mode(drone, "reset" if self._state(drone) == "emergency" else "emergency")

    def _state(self, drone: str) -> str:
        key = keys.status(drone)
        for sample in self._link.get(key, timeout_s=STATUS_S):
            try:
                return messages.decode(key, sample.payload).state
            except DecodeError as error:
                raise ValueError(str(error)) from error
        raise ValueError(f"the state of {drone} is not known: the world does not answer")

    def _next_stamp(self, key: str) -> tuple[int, int]:
        """Return t_ns and seq of the next command on a key."""
        seq = self._seq.get(key, 0)
        self._seq[key] = seq + 1
        return self._observer.now_ns, seq

    def request_cluster(self, cluster: str, op: str) -> Any:
        """Request an operation of a cluster's controller; return the response."""
        return self._request(keys.cluster_control(cluster), op, {})

    def release(self, drone: str) -> Any:
        """Let others command a drone; return the response."""
        return self._request(keys.CONTROL, "release", {"drone": drone})

    def _request(self, key: str, op: str, args: dict[str, Any]) -> Any:
        answer = self._link.request(key, op, self._observer.name, args)
        return self._response(answer.ok, answer.error)
