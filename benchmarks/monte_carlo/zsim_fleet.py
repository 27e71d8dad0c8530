"""zsim's world alone, following the paths as the peers do: firmware, all sensors with noise, gusts, contacts.

At every gate, a position controller that knows the truth (path velocity plus a gain times the position error) gives
velocity commands, and the samples and truth of all drones are produced. No estimators, cluster controller, messages or
verdicts; one flight at a time.
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
GAIN_1_S = 0.6  # for position and yaw, as in the cluster controller


def main() -> None:
    serve(build, flights=1)


def build(way: Way, given: argparse.Namespace) -> Fly:
    """Return a function that makes `flights` flights of Test 1's scenario, each with another seed."""
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
    """Steer all drones towards their points on the paths; at TAKEOFF_S, make them take off."""
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
