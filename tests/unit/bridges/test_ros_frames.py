"""Rotations and times as ROS writes them, against scipy and by example."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim_bridges import ros_frames


def test_a_time_is_seconds_and_nanoseconds():
    assert ros_frames.ros1_stamp(12_340_000_005) == (12, 340_000_005)
    assert ros_frames.ros1_stamp(0) == (0, 0)


def test_there_is_no_time_before_the_start():
    assert ros_frames.ros1_stamp(-5_000_000) == (0, 0)


def test_rotations_agree_with_scipy():
    rng = np.random.default_rng(4)
    for rotation, v in zip(Rotation.random(50, rng), rng.normal(size=(50, 3)), strict=True):
        w, x, y, z = rotation.as_quat(scalar_first=True).tolist()
        q = (w, x, y, z)
        yaw, pitch, roll = rotation.as_euler("ZYX")
        assert ros_frames.rpy(q) == pytest.approx((roll, pitch, yaw), abs=1e-9)
        assert ros_frames.rotated(q, tuple(v)) == pytest.approx(rotation.apply(v), abs=1e-12)
        assert ros_frames.tilt_cosine(q) == pytest.approx(rotation.as_matrix()[2, 2], abs=1e-12)
        assert ros_frames.xyzw(q) == pytest.approx(rotation.as_quat(), abs=1e-15)


def test_a_nose_to_the_north_has_a_yaw_of_90_degrees():
    q = (math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4))
    assert ros_frames.yaw(q) == pytest.approx(math.pi / 2)


def test_names_have_letters_digits_and_underscores():
    assert ros_frames.ros1_name("drone-1.a") == "drone_1_a"
