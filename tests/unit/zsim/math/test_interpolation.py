import math

import numpy as np
import pytest

from zsim.math.rotation import Quaternion, Vector, about_z, from_rotation_vector, multiply, pose_between

P0, V0 = (1.0, -2.0, 3.0), (0.5, 0.0, -1.0)
P1, V1 = (1.02, -1.99, 2.97), (0.7, 0.4, -1.2)
Q0 = multiply(about_z(0.7), from_rotation_vector((0.1, -0.2, 0.0)))
TURN = (0.3, -0.1, 0.2)  # rad, within the span
Q1 = multiply(Q0, from_rotation_vector(TURN))
SPAN = 0.02  # s


def between(s: float, q0: Quaternion = Q0, q1: Quaternion = Q1) -> tuple[Vector, Vector, Quaternion]:
    return pose_between(5.0 + s * SPAN, 5.0, P0, V0, q0, 5.0 + SPAN, P1, V1, q1)


@pytest.mark.parametrize(("s", "p", "v", "q"), [(0.0, P0, V0, Q0), (1.0, P1, V1, Q1)])
def test_the_ends_are_what_was_given(s: float, p: Vector, v: Vector, q: Quaternion) -> None:
    for found, given in zip(between(s), (p, v, q), strict=True):
        assert found == pytest.approx(given, abs=1e-9)


def test_a_flight_with_constant_jerk_is_exact() -> None:
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


def test_the_other_sign_of_a_quaternion_is_the_same_attitude() -> None:
    w, x, y, z = Q1
    assert between(0.3, q1=(-w, -x, -y, -z))[2] == pytest.approx(between(0.3)[2])


def test_equal_attitudes_stay() -> None:
    assert between(0.3, q1=Q0)[2] == pytest.approx(Q0, abs=1e-15)
    almost = multiply(Q0, from_rotation_vector((1e-4, 0.0, 0.0)))
    assert math.dist(between(0.5, q1=almost)[2], multiply(Q0, from_rotation_vector((0.5e-4, 0.0, 0.0)))) < 1e-12
