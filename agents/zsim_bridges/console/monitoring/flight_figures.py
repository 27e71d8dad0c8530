"""Figures of each drone's flight, from the views of where the drones truly are: speed, attitude, time of battery."""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from zsim.contract.flight_messages import DroneView, ViewDrones
from zsim.math import frames

SPEED_S = 0.2  # simulated, over which a speed is taken: shorter, and it is that of a rounding
BATTERY_S = 20.0  # simulated, over which a battery must have been seen before its time left is shown
BATTERY_POINTS_MAX = 120
BATTERY_SPACING_S = 1.0  # simulated


class FlightFigures(NamedTuple):
    """Figures of one drone; positions and velocities in W, heading from east to north."""

    position_m: tuple[float, float, float]
    speed_m_s: float
    climb_m_s: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float  # 0 to 360
    battery_left_s: float | None  # at the present drain; None while that is not known


class _Track:
    """Where one drone was, and its battery, lately."""

    def __init__(self) -> None:
        self.places: deque[tuple[float, tuple[float, float, float]]] = deque(maxlen=64)
        self.charges: deque[tuple[float, float]] = deque(maxlen=BATTERY_POINTS_MAX)

    def add(self, t_s: float, drone: DroneView) -> None:
        """Add a view of the drone."""
        if not self.places or t_s > self.places[-1][0]:
            self.places.append((t_s, drone.position_m))
        while len(self.places) > 2 and t_s - self.places[1][0] >= SPEED_S:
            self.places.popleft()
        if not self.charges or t_s - self.charges[-1][0] >= BATTERY_SPACING_S:
            self.charges.append((t_s, drone.battery_percent))


class FlightMeter:
    """Keeps the figures of all drones of a run."""

    def __init__(self) -> None:
        self._tracks: dict[str, _Track] = {}
        self._t_s = -math.inf
        self._drones: tuple[DroneView, ...] = ()

    def update(self, view: ViewDrones) -> None:
        """Take over a view; one of an earlier time, as a replay may go, begins anew."""
        t_s = view.t_ns / 1e9
        if t_s < self._t_s:
            self._tracks.clear()
        self._t_s, self._drones = t_s, view.drones
        for drone in self._drones:
            self._tracks.setdefault(drone.name, _Track()).add(t_s, drone)

    @property
    def figures(self) -> dict[str, FlightFigures]:
        """Figures by drone, at the newest view."""
        return {drone.name: self._figures(drone) for drone in self._drones}

    def _figures(self, drone: DroneView) -> FlightFigures:
        track = self._tracks[drone.name]
        vx, vy, vz = _velocity(track)
        roll, pitch, yaw = np.degrees(frames.rpy_from_quaternion(np.array([drone.orientation_wxyz]))[0]).tolist()
        left_s = _battery_left_s(track, self._t_s, drone.battery_percent)
        return FlightFigures(drone.position_m, math.hypot(vx, vy, vz), vz, roll, pitch, yaw % 360.0, left_s)


def _velocity(track: _Track) -> tuple[float, float, float]:
    """Return the mean velocity [m/s; W] over the last SPEED_S, or the last two views."""
    (first_s, first), (last_s, last) = track.places[0], track.places[-1]
    if last_s <= first_s:
        return 0.0, 0.0, 0.0
    vx, vy, vz = ((b - a) / (last_s - first_s) for a, b in zip(first, last, strict=True))
    return vx, vy, vz


def _battery_left_s(track: _Track, t_s: float, percent: float) -> float | None:
    first_s, first = track.charges[0]
    if t_s - first_s < BATTERY_S or first - percent <= 0.0:
        return None
    return percent * (t_s - first_s) / (first - percent)
