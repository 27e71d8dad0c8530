"""A drone sent to places, to another one at any time: its course has no jumps in position or velocity."""

import math

import numpy as np
import pytest

from zsim.scenario.scenario import Piloted
from zsim_agents.references.cruise import DEVIATION_MAX_M, Axes, Course, Cruise, velocity_towards
from zsim_agents.references.path import SHARE, PathLimits

LIMITS = PathLimits(5.0, 1.0, 1.0, 2.5)
LAW = Piloted(lead_s=0.0)
GATE_S = 0.02


class Follower:
    """A drone that follows velocity commands immediately, and its course."""

    def __init__(self) -> None:
        self.course = Course(LIMITS, LAW)
        self.here, self.moving, self.t_s = np.zeros(4), np.zeros(4), 0.0

    def send(self, *goal: float | None, **how: Cruise) -> None:
        x, y, z, yaw = goal
        self.course.send((x, y, z, yaw), self.t_s, self.here.tolist(), self.moving.tolist(), **how)

    def fly(self, seconds: float) -> np.ndarray:
        """Let time pass; return the velocities of all gates."""
        flown = []
        for _ in range(round(seconds / GATE_S)):
            velocity, turn = self.course.velocity(self.t_s, self.here.tolist(), self.moving.tolist())
            self.moving = np.array([*velocity, turn])
            self.here = self.here + self.moving * GATE_S
            self.t_s += GATE_S
            flown.append(self.moving)
        return np.array(flown)


def test_a_drone_holds_its_cruise_speed_and_arrives_on_time() -> None:
    drone = Follower()
    drone.send(20.0, 0.0, 0.0, math.pi / 2, speeds=Cruise(2.0))
    flown = drone.fly(20 / 2 + 2 / (SHARE * 2.5))
    assert flown[:, 0].max() == pytest.approx(2.0)
    assert (flown[:, 0] > 1.999).mean() > 0.8
    assert drone.here == pytest.approx([20, 0, 0, math.pi / 2], abs=0.05)


def test_a_drone_sent_elsewhere_turns_within_its_acceleration() -> None:
    drone = Follower()
    drone.send(20.0, 0.0, 0.0, None)
    before = drone.fly(3.0)
    assert before[-1, 0] > 4.0
    drone.send(5.0, 10.0, 2.0, None)
    after = drone.fly(12.0)
    steps = np.diff(np.vstack([before, after])[:, :2], axis=0)
    assert np.hypot(*steps.T).max() < 1.2 * SHARE * 2.5 * GATE_S
    assert drone.here[:3] == pytest.approx([5, 10, 2], abs=0.02)
    assert not after[:, 3].any()


def test_a_displaced_drone_replans_from_where_it_is() -> None:
    drone = Follower()
    drone.send(0.0, 20.0, 0.0, None)
    drone.fly(3.0)
    drone.here[0] += DEVIATION_MAX_M + 0.1
    flown = drone.fly(0.5)
    assert abs(flown[0, 0]) < 0.2  # it does not hurry back to its former course
    drone.fly(12.0)
    assert drone.here[:2] == pytest.approx([0, 20], abs=0.02)


def test_axes_follow_a_rate_or_a_moving_place() -> None:
    drone = Follower()
    drone.course.send((None, 4.0, None, None), 0.0, [0.0] * 4, [0.0] * 4, rate=(0.5, 0.0, 0.0, 0.3))
    flown = drone.fly(6.0)
    assert flown[:, 0] == pytest.approx(0.5)
    assert flown[:, 3] == pytest.approx(0.3)
    assert drone.here[1] == pytest.approx(4.0, abs=0.02)
    drone.course.send((9.0, 4.0, None, None), drone.t_s, drone.here.tolist(), [0.0] * 4, rate=(1.0, 0.0, 0.0, 0.0))
    x = drone.here[0]
    assert drone.course.velocity(drone.t_s, drone.here.tolist(), [0.0] * 4)[0][0] == pytest.approx(
        1.0 + LAW.gain_1_s * (9.0 - x)
    )


def test_a_drone_stops_after_its_braking_distance() -> None:
    course = Course(LIMITS, LAW)
    place = course.stop(0.0, (1.0, 2.0, 3.0, 0.0), (3.0, 4.0, 0.0, 0.0))
    brake_m = 25 / (2 * SHARE * 2.5)
    assert place == pytest.approx((1 + 0.6 * brake_m, 2 + 0.8 * brake_m, 3), abs=1e-6)


@pytest.mark.parametrize(
    ("goal", "least"), [((99.0, 99.0, 99.0, 3.0), (1.0, 0.4)), ((-99.0, 0.0, -99.0, -3.0), (1.0, 0.4))]
)
def test_the_law_keeps_within_its_limits(goal: Axes, least: tuple[float, float]) -> None:
    place = [float(each or 0.0) for each in goal]
    (x, y, z), turn = velocity_towards(place, (0.0,) * 4, (0.0,) * 4, LIMITS, LAW, down_m_s=0.4)
    assert math.hypot(x, y) == pytest.approx(5.0)
    assert z == (least[0] if place[2] > 0 else -least[1])
    assert abs(turn) == 1.0
