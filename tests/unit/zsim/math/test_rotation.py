"""Quaternion algebra of the compiled code against scipy; interpolated poses between two instants."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from zsim.math import rotation as rot
from zsim.math.rotation import Quaternion, Vector, about_z, from_rotation_vector, multiply, pose_between

number = st.floats(-5.0, 5.0)
vectors = st.tuples(number, number, number)
quaternions = st.tuples(number, number, number, number).filter(lambda q: sum(x * x for x in q) > 1e-2)
few = settings(max_examples=50, deadline=None)


def unit(q) -> rot.Quaternion:
    w, x, y, z = (np.array(q) / np.linalg.norm(q)).tolist()
    return w, x, y, z


def scipy_rotation(q):
    return Rotation.from_quat(q, scalar_first=True)


@few
@given(quaternions, vectors)
def test_rotate_agrees_with_scipy_and_rotate_back_inverts_it(q, v):
    q = unit(q)
    turned = rot.rotate(q, v)
    np.testing.assert_allclose(turned, scipy_rotation(q).apply(v), atol=1e-12)
    np.testing.assert_allclose(rot.rotate_back(q, turned), v, atol=1e-12)


@few
@given(quaternions, quaternions, vectors)
def test_a_product_rotates_by_the_right_factor_first(p, q, v):
    p, q = unit(p), unit(q)
    np.testing.assert_allclose(rot.rotate(rot.multiply(p, q), v), rot.rotate(p, rot.rotate(q, v)), atol=1e-12)


@few
@given(quaternions, quaternions, vectors)
def test_matrices_agree_with_scipy(p, q, v):
    p, q = unit(p), unit(q)
    R, expected = rot.matrix(p), scipy_rotation(p)
    np.testing.assert_allclose(R, expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rot.product(R, v), expected.apply(v), atol=1e-11)
    np.testing.assert_allclose(rot.product(rot.transposed(R), v), expected.inv().apply(v), atol=1e-11)
    np.testing.assert_allclose(rot.column(R, 1), expected.as_matrix()[:, 1], atol=1e-12)
    both = (expected * scipy_rotation(q)).as_matrix()
    np.testing.assert_allclose(rot.composed(R, rot.matrix(q)), both, atol=1e-12)


@few
@given(vectors)
def test_a_matrix_from_euler_angles_applies_yaw_last(rpy):
    expected = Rotation.from_euler("xyz", rpy).as_matrix()
    np.testing.assert_allclose(rot.matrix_from_rpy(*rpy), expected, atol=1e-12)


@few
@given(vectors)
def test_a_rotation_vector_agrees_with_scipy(r):
    expected = Rotation.from_rotvec(r).as_matrix()
    got = scipy_rotation(rot.from_rotation_vector(r)).as_matrix()
    np.testing.assert_allclose(got, expected, atol=1e-12)
    tiny = rot.from_rotation_vector((3e-9, 0.0, 0.0))
    assert (tiny[0], tiny[1]) == pytest.approx((1.0, 1.5e-9), rel=1e-12)


@few
@given(quaternions, vectors)
def test_the_rate_is_the_derivative_of_the_attitude(q, w):
    q, h = unit(q), 1e-6
    ahead = rot.multiply(q, rot.from_rotation_vector((w[0] * h, w[1] * h, w[2] * h)))
    behind = rot.multiply(q, rot.from_rotation_vector((-w[0] * h, -w[1] * h, -w[2] * h)))
    difference = (np.array(ahead) - np.array(behind)) / (2 * h)
    np.testing.assert_allclose(rot.rate(q, w), difference, atol=1e-8)


@few
@given(quaternions)
def test_axes_and_heading_are_those_of_the_matrix(q):
    q = unit(q)
    matrix = scipy_rotation(q).as_matrix()
    np.testing.assert_allclose(rot.z_axis(q), matrix[:, 2], atol=1e-12)
    if math.hypot(matrix[0, 0], matrix[1, 0]) > 1e-3:
        assert abs(rot.wrapped(rot.heading(q) - math.atan2(matrix[1, 0], matrix[0, 0]))) < 1e-9


@few
@given(st.floats(-100.0, 100.0))
def test_wrapped_returns_the_same_angle_in_range(angle):
    wrapped = rot.wrapped(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.remainder(wrapped - angle, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_vector_functions_give_known_values():
    a, b = (1.0, 2.0, 3.0), (-4.0, 5.0, 0.5)
    np.testing.assert_allclose(rot.cross(a, b), np.cross(a, b))
    assert rot.norm(a) == math.sqrt(14.0)
    assert rot.axpy(a, 2.0, b) == (-7.0, 12.0, 4.0)
    np.testing.assert_allclose(rot.normalised((2.0, 0.0, 0.0, 0.0)), (1.0, 0.0, 0.0, 0.0))


P0, V0 = (1.0, -2.0, 3.0), (0.5, 0.0, -1.0)
P1, V1 = (1.02, -1.99, 2.97), (0.7, 0.4, -1.2)
Q0 = multiply(about_z(0.7), from_rotation_vector((0.1, -0.2, 0.0)))
TURN = (0.3, -0.1, 0.2)  # rad, during the span
Q1 = multiply(Q0, from_rotation_vector(TURN))
SPAN = 0.02  # s


def between(s: float, q0: Quaternion = Q0, q1: Quaternion = Q1) -> tuple[Vector, Vector, Quaternion]:
    return pose_between(5.0 + s * SPAN, 5.0, P0, V0, q0, 5.0 + SPAN, P1, V1, q1)


@pytest.mark.parametrize(("s", "p", "v", "q"), [(0.0, P0, V0, Q0), (1.0, P1, V1, Q1)])
def test_interpolation_reproduces_the_given_ends(s: float, p: Vector, v: Vector, q: Quaternion) -> None:
    for found, end in zip(between(s), (p, v, q), strict=True):
        assert found == pytest.approx(end, abs=1e-9)


def test_interpolation_is_exact_for_constant_jerk() -> None:
    def flight(t: float) -> tuple[Vector, Vector]:
        return (t**3, 2 * t**2, 1 - t), (3 * t**2, 4 * t, -1.0)

    (p0, v0), (p1, v1) = flight(0.4), flight(0.6)
    for t in np.linspace(0.4, 0.6, 7):
        p, v, _ = pose_between(float(t), 0.4, p0, v0, Q0, 0.6, p1, v1, Q1)
        assert p == pytest.approx(flight(t)[0], abs=1e-12)
        assert v == pytest.approx(flight(t)[1], abs=1e-11)


@pytest.mark.parametrize("s", [0.1, 0.5, 0.9])
def test_the_attitude_turns_at_a_constant_rate(s: float) -> None:
    x, y, z = TURN
    assert between(s)[2] == pytest.approx(multiply(Q0, from_rotation_vector((s * x, s * y, s * z))), abs=1e-12)


def test_interpolation_handles_opposite_signs_and_equal_quaternions() -> None:
    w, x, y, z = Q1
    assert between(0.3, q1=(-w, -x, -y, -z))[2] == pytest.approx(between(0.3)[2])
    assert between(0.3, q1=Q0)[2] == pytest.approx(Q0, abs=1e-15)
    almost = multiply(Q0, from_rotation_vector((1e-4, 0.0, 0.0)))
    assert math.dist(between(0.5, q1=almost)[2], multiply(Q0, from_rotation_vector((0.5e-4, 0.0, 0.0)))) < 1e-12
