"""A real aircraft's readings as the messages of one drone, gate by gate. Pure."""

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from zsim.contract import flight_messages, keys
from zsim.scenario.scenario import Drone
from zsim.sensors.sensor_catalogue import STOCK
from zsim_bridges.vehicle_links.aircraft_state import STANDING, STILL, AircraftPose, AircraftState, Reading

WAITING_MAX = 4000  # readings, 10 s of an IMU at 200 Hz and all else; then the oldest go
EXTRAPOLATED_NS = 500_000_000  # chosen: how old a pose may be; it then says where the aircraft was, not where it is


class ExternalDrone:
    """Numbers and stamps what has come of an aircraft since the last gate.

    Args:
        drone: its name.
        to_simulated: simulated time at a time of this process's clock.
        hover_rad_s: speed of each rotor at which the drone hovers: no wire tells how fast they turn, and others fly in
            their downwash.
    """

    def __init__(
        self, drone: str, to_simulated: Callable[[int], int], hover_rad_s: tuple[float, ...] = (0.0,) * 4
    ) -> None:
        self._hover_rad_s = hover_rad_s
        self._drone = drone
        self._to_simulated = to_simulated
        self._readings: deque[Reading] = deque(maxlen=WAITING_MAX)
        self._seq: dict[str, int] = {}
        self._gate_ns = -1

    def add(self, readings: Iterable[Reading]) -> None:
        """Keep readings for the next gate."""
        self._readings.extend(readings)

    def gate(self, t_ns: int, vehicle: AircraftState, commander: str | None) -> list[tuple[str, Any]]:
        """Return keys and messages of a gate in order: samples by time, truth, and status; nothing for an old gate."""
        if t_ns <= self._gate_ns or vehicle.pose is None:
            return []
        self._gate_ns = t_ns
        samples, truth = self._samples(t_ns), self._truth(t_ns, vehicle.pose, turning=vehicle.state not in STANDING)
        return [*samples, truth, self._status(t_ns, vehicle, commander, len(samples) + 1)]

    def _status(self, t_ns: int, vehicle: AircraftState, commander: str | None, count: int) -> tuple[str, Any]:
        key = keys.status(self._drone)
        state, battery = vehicle.state, vehicle.battery_percent
        return key, flight_messages.Status(t_ns, self._next(key), state, battery, False, commander, count)

    def _samples(self, t_ns: int) -> list[tuple[str, Any]]:
        """Return the messages of what has been measured, in order of time; none is of the future."""
        taken = [(min(t_ns, self._to_simulated(reading.taken_ns)), reading) for reading in self._readings]
        self._readings.clear()
        taken.sort(key=lambda entry: entry[0])
        return [self._sample(t_ns, max(0, sample_ns), reading) for sample_ns, reading in taken]

    def _sample(self, t_ns: int, t_sample_ns: int, reading: Reading) -> tuple[str, Any]:
        key = keys.sensor(self._drone, reading.sensor)
        return key, STOCK[reading.sensor].message(t_ns, self._next(key), t_sample_ns, *reading.values)

    def _truth(self, t_ns: int, pose: AircraftPose, turning: bool) -> tuple[str, Any]:
        """Return the pose as it is at the gate, carried on with its velocity."""
        age_ns = max(0, min(EXTRAPOLATED_NS, t_ns - self._to_simulated(pose.taken_ns)))
        x, y, z = (p + age_ns * 1e-9 * v for p, v in zip(pose.position_m, pose.velocity_m_s, strict=True))
        key = keys.truth(self._drone)
        rotors = self._hover_rad_s if turning else (0.0,) * len(self._hover_rad_s)
        motion = ((x, y, z), pose.velocity_m_s, pose.q_WB, pose.w_WB_B, STILL, rotors)
        return key, flight_messages.Truth(t_ns, self._next(key), *motion)

    def _next(self, key: str) -> int:
        self._seq[key] = self._seq.get(key, -1) + 1
        return self._seq[key]


def hover_speed(drone: Drone, rotors: int, gravity_m_s2: float) -> float:
    """Return the speed [rad/s] of each of so many rotors that carries a drone."""
    return math.sqrt(drone.mass_kg * gravity_m_s2 / (rotors * drone.thrust_n_s2))
