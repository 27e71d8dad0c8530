"""zsim's world alone, following the ways as the peers do: firmware, all noisy sensors, gusts, contacts.

Each gate a position controller that knows the truth (velocity of the way and a share of the distance) gives velocity
commands, and the samples and the truth of all drones are taken out. No estimators, cluster controller, messages, or
judging; a flight at a time.
"""

import argparse
import math

import numpy as np
from msgspec.structs import replace

from benchmarks.monte_carlo.way import Way
from benchmarks.monte_carlo.worker import Flown, Fly, serve
from benchmarks.monte_carlo.zsim_sweep import TEST_1
from zsim.scenario import scenario_file
from zsim_world.fleet.fleet import Fleet

TAKEOFF_S = 20.0  # scenarios/step.yaml
GAIN_1_S = 0.6  # of position and yaw, as the cluster controller's


def main() -> None:
    serve(build, flights=1)


def build(way: Way, given: argparse.Namespace) -> Fly:
    """Return flights of Test 1's scenario, another seed for each."""
    scenario = scenario_file.load(TEST_1)

    def flown(seed: int) -> Flown:
        rng = np.random.default_rng([seed, given.worker])
        seeds = rng.integers(1, 2**31, size=given.flights).tolist()
        done = [_follow(way, Fleet(replace(scenario, seed=each))) for each in seeds]
        rms_m = math.sqrt(sum(each.rms_m**2 for each in done) / len(done))
        return Flown(float(len(done)), rms_m, min(each.closest_m for each in done))

    return flown


def _follow(way: Way, fleet: Fleet) -> Flown:
    squares, closest = 0.0, math.inf
    for p_W, v_W, yaw in zip(way.p_W[1:], way.v_W[1:], way.yaw[1:], strict=True):
        _command(fleet, p_W, v_W, yaw)
        fleet.advance()
        closest = min(closest, fleet.closest_m)
        squares += float(np.sum((fleet.truth().position_m - p_W) ** 2))
    return Flown(1.0, math.sqrt(squares / (3 * (len(way.p_W) - 1))), closest)


def _command(fleet: Fleet, p_W: np.ndarray, v_W: np.ndarray, yaw: np.ndarray) -> None:
    """Send all drones after their points; those on the ground take off when it is time."""
    truth = fleet.truth()
    wanted_W = v_W + GAIN_1_S * (p_W - truth.position_m)
    if fleet.t_ns == round(TAKEOFF_S * 1e9):
        for i in range(fleet.count):
            fleet.takeoff(i)
    for i, (w, x, y, z) in enumerate(truth.orientation_wxyz.tolist()):
        heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        c, s = math.cos(heading), math.sin(heading)
        vx, vy, vz = wanted_W[i].tolist()
        turn = math.remainder(yaw[i] - heading, 2 * math.pi)
        fleet.set_velocity(i, (c * vx + s * vy, c * vy - s * vx, vz), GAIN_1_S * turn)


if __name__ == "__main__":
    main()
