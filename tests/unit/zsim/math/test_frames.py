"""Geodesy against its inverse and independent formulas, and conversions of attitudes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from zsim.math import frames
from zsim.math.frames import WGS84_A_M, WGS84_F, anchor, geodetic, geodetic_to_enu

few = settings(max_examples=100, deadline=None)
angle = st.floats(-math.pi, math.pi)


@pytest.mark.parametrize(
    ("geodetic", "ecef"),
    [
        ((0.0, 0.0, 0.0), (6378137.0, 0.0, 0.0)),
        ((0.0, 90.0, 100.0), (0.0, 6378237.0, 0.0)),
        # the pole: the semi-minor axis of WGS 84, 6356752.314245 m
        ((90.0, 0.0, 0.0), (0.0, 0.0, 6356752.314245)),
        # 45 deg north, 45 deg east, by hand: N = a / sqrt(1 - e^2 / 2) = 6388838.290 m
        ((45.0, 45.0, 0.0), (3194419.145061, 3194419.145061, 4487348.408866)),
    ],
)
def test_earth_fixed_coordinates_of_known_places_are_correct(geodetic, ecef):
    np.testing.assert_allclose(frames.geodetic_to_ecef(geodetic), ecef, atol=1e-6)


@few
@given(angle, st.floats(-1.5, 1.5), angle)
def test_euler_angles_agree_with_scipy(roll, pitch, yaw):
    q = frames.quaternion_from_rpy((roll, pitch, yaw))
    expected = Rotation.from_euler("ZYX", (yaw, pitch, roll))
    np.testing.assert_allclose(frames.rotation_matrix(q), expected.as_matrix(), atol=1e-12)
    back = frames.rpy_from_quaternion(q)
    np.testing.assert_allclose(frames.wrap_angle(back - (roll, pitch, yaw)), 0.0, atol=1e-7)
    np.testing.assert_allclose(frames.wrap_angle(frames.heading(q) - yaw), 0.0, atol=1e-9)


def test_a_matrix_converts_back_to_its_quaternion():
    """Random attitudes, and half turns about each axis, whose quaternions have a single non-zero component."""
    q = np.random.default_rng(4).normal(size=(5, 40, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    again = frames.quaternion_from_matrix(frames.rotation_matrix(q))
    np.testing.assert_allclose(np.abs((again * q).sum(axis=-1)), 1.0, atol=1e-12)
    np.testing.assert_allclose(frames.quaternion_from_matrix(frames.rotation_matrix(np.eye(4))), np.eye(4))
    turn = Rotation.from_quat(again[0, 0], scalar_first=True).as_matrix()
    np.testing.assert_allclose(turn, frames.rotation_matrix(q[0, 0]), atol=1e-12)


def test_principal_axes_reproduce_their_covariance():
    half = np.random.default_rng(3).standard_normal((20, 3, 3))
    covariance = half @ np.swapaxes(half, -1, -2)
    sigma, axes = frames.principal_axes(covariance)
    R = frames.rotation_matrix(axes)
    np.testing.assert_allclose(R * np.square(sigma)[:, None, :] @ np.swapaxes(R, -1, -2), covariance, atol=1e-12)


def test_products_and_inverses_broadcast_over_leading_axes():
    rng = np.random.default_rng(2)
    p, q = rng.normal(size=(2, 4, 4))
    p, q = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (p, q))
    v = rng.normal(size=(4, 3))
    left = frames.rotate(frames.quaternion_multiply(p, q), v)
    np.testing.assert_allclose(left, frames.rotate(p, frames.rotate(q, v)), atol=1e-12)
    np.testing.assert_allclose(frames.rotate(p * (1.0, -1.0, -1.0, -1.0), frames.rotate(p, v)), v, atol=1e-12)


def test_heading_is_counter_clockwise_from_east():
    q = frames.quaternion_from_heading(math.pi / 2)
    np.testing.assert_allclose(frames.rotate(q, (1, 0, 0)), (0, 1, 0), atol=1e-15)
    assert math.isclose(float(frames.heading(q)), math.pi / 2)


def test_wrap_angle_returns_angles_from_minus_pi_to_below_pi():
    wrapped = frames.wrap_angle([math.pi, -math.pi, 3 * math.pi / 2])
    np.testing.assert_allclose(wrapped, [-math.pi, -math.pi, -math.pi / 2])


ORIGIN = (-34.603, -58.368, 25.0)


def place_of(position, origin=ORIGIN):
    """Return latitude, longitude and height of one point of W."""
    return geodetic(np.array([position], dtype=float), *anchor(*origin))[0]


@few
@given(st.floats(-89.9, 89.9), st.floats(-179.9, 180.0), st.floats(-5e3, 1e5), st.tuples(*[st.floats(-1e4, 1e4)] * 3))
def test_conversion_to_the_tangent_plane_and_back_is_exact(latitude, longitude, height, position):
    origin = latitude, longitude, height
    np.testing.assert_allclose(place_of((0.0, 0.0, 0.0), origin), origin, atol=1e-8)
    np.testing.assert_allclose(geodetic_to_enu(place_of(position, origin), origin), position, atol=1e-7)


def test_small_steps_follow_the_radii_of_curvature():
    # an independent formula: meridian radius M and normal radius N at the origin
    lat = math.radians(ORIGIN[0])
    e2 = WGS84_F * (2 - WGS84_F)
    s = 1 - e2 * math.sin(lat) ** 2
    meridian = WGS84_A_M * (1 - e2) / s**1.5 + ORIGIN[2]
    normal = WGS84_A_M / math.sqrt(s) + ORIGIN[2]
    north, east = place_of((0, 1.0, 0)), place_of((1.0, 0, 0))
    assert math.isclose(math.radians(north[0] - ORIGIN[0]), 1 / meridian, rel_tol=1e-6)
    assert math.isclose(math.radians(east[1] - ORIGIN[1]), 1 / (normal * math.cos(lat)), rel_tol=1e-6)
    np.testing.assert_allclose(place_of((0, 0, 7.0)), (*ORIGIN[:2], ORIGIN[2] + 7.0), atol=1e-9)
