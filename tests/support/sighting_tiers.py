"""Comparison of the two tiers of sightings, rendered and geometric, over the same truth, without a run.

The rendered tier draws pictures and runs the detector on them; the geometric tier is the world's. The truth of each
picture is drawn at random: one drone looks at two others, whose hats are anywhere in its picture. Both tiers receive
this truth at the same instant, and each has its own random stream.
"""

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pictures import FRONT, HATS, Look, bodies, renderer, scene

from zsim.contract.flight_messages import Seen
from zsim.math.frames import quaternion_from_rpy, rotation_matrix
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera_model import camera_pose, lens_of, undistorted
from zsim_agents.cameras.detector import HatDetector, decoded
from zsim_agents.cameras.scene import DroneStates
from zsim_world.physics import rays
from zsim_world.sensors.sightings import SightingSampler

Array = NDArray[np.float64]
RATE_HZ = 10.0  # rate of the geometric tier's camera: a picture at every gate of 0.1 s
GATE_NS = 100_000_000
OTHERS = 2
HULL_M = 0.26  # radius of the AR.Drone's hull
APART_RAD = 0.3  # least angle between two hats, so that no hull hides the other drone's hat
ASSOCIATED_RAD = 0.04  # greatest angle from a hat at which a sighting is associated with it
TILT_RAD = 0.06  # standard deviation of roll and pitch
FROM_ABOVE = (-0.35, -0.03)  # rise per metre from the camera to the hat: no hull hides its own drone's hat
FROM_BELOW = (0.05, 0.25)  # 3 to 14 deg: the rotors of its drone hide a part of the hat
SCENARIO = """
name: tiers
seed: 5
duration_s: 3600
sensors: {{front_camera: {{rate_hz: {rate_hz}}}, sightings: {{}}}}
environment: {{light: {light}}}
drones:
  - {{name: drone1, position_m: [0, 0, 0]}}
  - {{name: drone2, position_m: [4, 0, 0]}}
  - {{name: drone3, position_m: [8, 0, 0]}}
processes: {{expect: []}}
"""
LENS, POSE = lens_of(FRONT), camera_pose(FRONT)


class Condition(NamedTuple):
    """Conditions under which pictures are taken.

    Attributes:
        ranges_m: least and greatest range of the hats.
        light: light relative to a clear day.
        rate_deg_s: angular rate of the drone that carries the camera, about a random axis.
        rise: least and greatest rise per metre from the camera to a hat.
    """

    ranges_m: tuple[float, float]
    light: float = 1.0
    rate_deg_s: float = 0.0
    rise: tuple[float, float] = FROM_ABOVE


class Tier(NamedTuple):
    """Results of a tier, with M sighted hats.

    Attributes:
        errors: errors of the direction, sideways and down [rad], and relative error of the range, (M, 3).
        sigmas: standard deviations that the tier reports, of direction [rad] and relative range, (M, 2).
        missed: share of the hats in the pictures without a sighting.
        false: false sightings per picture.
    """

    errors: Array
    sigmas: Array
    missed: float
    false: float

    def spread(self, quantile: float) -> tuple[float, float]:
        """Return a quantile of the absolute errors of bearing [rad] and relative range."""
        size = np.abs(self.errors)
        return float(np.quantile(size[:, :2], quantile)), float(np.quantile(size[:, 2], quantile))

    def deviation(self) -> tuple[float, float]:
        """Return the standard deviations of bearing [rad], per axis, and relative range."""
        return float(self.errors[:, :2].std()), float(self.errors[:, 2].std())

    def mean(self) -> Array:
        """Return the mean errors of the direction, down [rad], and of the relative range."""
        return self.errors[:, 1:].mean(axis=0)

    def bias(self) -> Array:
        """Return the mean errors divided by their standard deviations, (3,)."""
        return self.errors.mean(axis=0) / self.errors.std(axis=0)

    def normalised(self) -> tuple[float, float]:
        """Return the root mean square errors of bearing and range, normalised by the reported standard deviations."""
        over = self.errors / self.sigmas[:, [0, 0, 1]]
        return float(np.sqrt((over[:, :2] ** 2).mean())), float(np.sqrt((over[:, 2] ** 2).mean()))


class Tiers(NamedTuple):
    """Results of both tiers over the same truth."""

    rendered: Tier
    geometric: Tier


class _Tally:
    """Associates a tier's sightings with hats, and counts false ones."""

    def __init__(self) -> None:
        self._rows: list[list[float]] = []
        self._hats = self._false = self._pictures = 0

    def take(self, seen: Sequence[Seen], hats: Sequence[Look]) -> None:
        left = list(seen)
        for hat in hats:
            near = [each for each in left if _off(each, hat) < ASSOCIATED_RAD]
            if near:
                best = min(near, key=lambda each: _off(each, hat))
                left.remove(best)
                self._rows.append(_row(best, hat))
        self._hats += len(hats)
        self._false += len(left)
        self._pictures += 1

    def tier(self) -> Tier:
        rows = np.array(self._rows)
        return Tier(rows[:, :3], rows[:, 3:], 1 - len(rows) / self._hats, self._false / self._pictures)


def _off(seen: Seen, hat: Look) -> float:
    return math.dist(seen.direction_B, hat.direction_B.tolist())


def _row(seen: Seen, hat: Look) -> list[float]:
    d = hat.direction_B
    side = np.cross(d, (0.0, 0.0, 1.0)) / math.hypot(*d[:2])
    off = np.array(seen.direction_B) - d
    sigmas = seen.sigma_direction_rad, seen.sigma_range_m / hat.range_m
    return [float(off @ side), float(off @ np.cross(d, side)), seen.range_m / hat.range_m - 1, *sigmas]


def measured(condition: Condition, pictures: int, seed: int = 3) -> Tiers:
    """Return the results of both tiers over a number of pictures."""
    rng = np.random.default_rng(seed)
    drawn = renderer(FRONT, scene(1 + OTHERS, light=condition.light))
    detector = HatDetector(LENS, POSE, HATS.diameter_m)
    sampler = SightingSampler(
        scenario(condition.light), np.full(1 + OTHERS, HULL_M), rays.scene(np.empty(0), np.empty(0))
    )
    rendered, geometric = _Tally(), _Tally()
    for number in range(pictures):
        hats = looks(condition, rng)
        data = drawn.jpeg(number, number / RATE_HZ, hats[0].where)
        rendered.take(detector.seen(decoded(data, FRONT.width_px, FRONT.height_px)), hats)
        due = sampler.due(state_of(hats[0].where), number * GATE_NS)
        geometric.take([seen for each in due if each.drone == 0 for seen in each.seen], hats)
    return Tiers(rendered.tier(), geometric.tier())


def state_of(where: DroneStates) -> Array:
    """Return the drones' states as rows of the world."""
    return np.hstack([where.p_WB, where.v_WB, where.q_WB, where.w_WB_B])


@cache
def scenario(light: float) -> Scenario:
    """Return a scenario with sightings at their default settings."""
    with TemporaryDirectory() as folder:
        place = Path(folder) / "tiers.yaml"
        place.write_text(SCENARIO.format(rate_hz=RATE_HZ, light=light))
        return scenario_file.load(place)


def looks(condition: Condition, rng: np.random.Generator) -> list[Look]:
    """Return the hats that are wholly or partly in one drone's picture; all share the same drones."""
    attitudes = [[*rng.normal(0, TILT_RAD, 2), rng.uniform(-math.pi, math.pi)] for _ in range(1 + OTHERS)]
    R_WB, *R_WD = (rotation_matrix(quaternion_from_rpy(np.array(each))) for each in attitudes)
    p = np.array([*rng.uniform(-20, 20, 2), rng.uniform(6, 9)])
    directions = _directions(R_WB, condition.rise, rng)
    near, far = (math.log(each) for each in condition.ranges_m)
    ranges = np.exp(rng.uniform(near, far, OTHERS)).tolist()
    hats_W = [p + R_WB @ (POSE.p_BK + away * d) for away, d in zip(ranges, directions, strict=True)]
    others = [hat - R @ np.array(HATS.position_m) for hat, R in zip(hats_W, R_WD, strict=True)]
    axis = rng.normal(size=3)
    rates = np.zeros((1 + OTHERS, 3))
    rates[0] = math.radians(condition.rate_deg_s) * axis / np.linalg.norm(axis)
    where = bodies([p, *others], attitudes, w_B=rates)
    return [Look(where, d, away) for d, away in zip(directions, ranges, strict=True)]


def _directions(R_WB: Array, rise: tuple[float, float], rng: np.random.Generator) -> list[Array]:
    """Return directions in B to hats anywhere in the picture, with the given rise and at least APART_RAD apart."""
    found: list[Array] = []
    while len(found) < OTHERS:
        u, v = rng.uniform(0, LENS.width), rng.uniform(0, LENS.height)
        ray = np.array([*undistorted(LENS, u - 0.5, v - 0.5), 1.0])
        d = POSE.R_BK @ (ray / np.linalg.norm(ray))
        rises = rise[0] < R_WB[2] @ d < rise[1]
        if rises and all(np.linalg.norm(d - other) > APART_RAD for other in found):
            found.append(d)
    return found
