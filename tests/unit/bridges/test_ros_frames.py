"""Rotations, times and names as ROS writes them, against scipy and by example."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim_bridges import ros_frames
from zsim_bridges.ros1.driver_messages import ros_time
from zsim_bridges.ros1.drone_topics import ros1_name


@pytest.mark.parametrize(("t_ns", "stamp"), [(12_340_000_005, (12, 340_000_005)), (0, (0, 0)), (-5_000_000, (0, 0))])
def test_a_time_is_seconds_and_nanoseconds_and_none_is_before_the_start(t_ns, stamp):
    time = ros_time(t_ns)
    assert (time.sec, time.nanosec) == stamp


def test_quaternions_end_with_w():
    for rotation in Rotation.random(5, np.random.default_rng(4)):
        q = tuple(rotation.as_quat(scalar_first=True).tolist())
        assert ros_frames.xyzw(q) == pytest.approx(rotation.as_quat(), abs=1e-15)


def test_a_mean_rate_is_that_of_the_turn_in_the_body():
    rng = np.random.default_rng(4)
    for before, turn in zip(Rotation.random(50, rng), rng.normal(size=(50, 3)), strict=True):
        after = before * Rotation.from_rotvec(turn)
        q1, q2 = (tuple(each.as_quat(scalar_first=True).tolist()) for each in (before, after))
        expected = Rotation.from_rotvec(turn).as_rotvec() / 0.1
        assert ros_frames.mean_rate(q1, q2, 0.1) == pytest.approx(expected, abs=1e-9)


def test_names_have_letters_digits_and_underscores():
    assert ros1_name("drone-1.a") == "drone_1_a"
