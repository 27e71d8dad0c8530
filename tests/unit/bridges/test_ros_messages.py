"""Rotations in the conventions of ROS, against SciPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim_bridges import ros_messages


def test_quaternions_end_with_w():
    for rotation in Rotation.random(5, np.random.default_rng(4)):
        q = ros_messages.quaternion(tuple(rotation.as_quat(scalar_first=True).tolist()))
        assert (q.x, q.y, q.z, q.w) == pytest.approx(rotation.as_quat(), abs=1e-15)


def test_the_mean_rate_is_that_of_the_rotation_in_the_body_frame():
    rng = np.random.default_rng(4)
    for before, turn in zip(Rotation.random(50, rng), rng.normal(size=(50, 3)), strict=True):
        after = before * Rotation.from_rotvec(turn)
        q1, q2 = (tuple(each.as_quat(scalar_first=True).tolist()) for each in (before, after))
        expected = Rotation.from_rotvec(turn).as_rotvec() / 0.1
        assert ros_messages.mean_rate(q1, q2, 0.1) == pytest.approx(expected, abs=1e-9)
