"""What a picture is drawn of: what stands still during a run, and what moves. Pure."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.contract.messages import DroneInfo, Info
from zsim.scenario.obstacle import row_of
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import Hats
from zsim.vehicles.vehicle import cross_layout

Array = NDArray[np.float64]
ARM_M = 0.1785  # m, of the AR.Drone, for records whose drones name no rotors
ROTOR_RADIUS_M = 0.10  # m, 8 inch propellers of the AR.Drone
SUN_AZIMUTH_RAD, SUN_ELEVATION_RAD = math.radians(215.0), math.radians(50.0)  # chosen: a winter noon seen from behind
SUN_W = np.array(
    [
        math.cos(SUN_ELEVATION_RAD) * math.cos(SUN_AZIMUTH_RAD),
        math.cos(SUN_ELEVATION_RAD) * math.sin(SUN_AZIMUTH_RAD),
        math.sin(SUN_ELEVATION_RAD),
    ]
)


class DroneLook(NamedTuple):
    """What a drone looks like: axes (R, 2), turns (R,) and radius of its rotors [m; B], and whether its hat is seen."""

    hubs_B: Array
    turns: Array
    radius_m: float
    has_hat: bool


class Scene(NamedTuple):
    """What stands still: looks of the drones, obstacles as rows of zsim.scenario.obstacle, hats, light of a day."""

    drones: tuple[DroneLook, ...]
    obstacles: tuple[tuple[float, ...], ...] = ()
    hats: Hats = Hats()
    light: float = 1.0


class DroneStates(NamedTuple):
    """N drones at an instant: position [m; W], velocity [m/s; W], attitude B to W (N, 4), rate [rad/s; B], (N, 3) each.

    `rotors` has the speeds of each drone's rotors [rad/s].
    """

    p_WB: Array
    v_WB: Array
    q_WB: Array
    w_WB_B: Array
    rotors: Sequence[Sequence[float]]


def scene_of(info: Info, scenario: Scenario) -> Scene:
    """Return what stands still in a run; the drones in the order of `info`."""
    environment = scenario.environment
    hats = Hats() if environment.hats is UNSET else environment.hats
    light = 1.0 if environment.light is UNSET else environment.light
    looks = tuple(_look(drone, drone.name not in hats.covered) for drone in info.drones)
    return Scene(looks, tuple(tuple(row_of(obstacle)) for obstacle in environment.obstacles), hats, light)


def default_look(has_hat: bool = True) -> DroneLook:
    """Return what the AR.Drone looks like."""
    return _look(DroneInfo("", ""), has_hat)


def _look(drone: DroneInfo, has_hat: bool) -> DroneLook:
    rotors = drone.rotors or cross_layout(ARM_M)
    radius_m = drone.rotors[0].radius_m if drone.rotors else ROTOR_RADIUS_M
    hubs = np.array([(rotor.x_m, rotor.y_m) for rotor in rotors])
    return DroneLook(hubs, np.array([float(rotor.turn) for rotor in rotors]), radius_m, has_hat)
