"""Where sightings fall on a picture, and what is written beside them."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
import synthetic_camera
from hypothesis import given
from hypothesis import strategies as st

from zsim.contract.camera_messages import CameraInfo, Seen, Sightings
from zsim_bridges.console.camera_feed import (
    AGE_MAX_NS,
    RADIUS_MIN_PX,
    field_of_view,
    is_usable,
    marks_of,
    range_text,
    sightings_of,
)

HAT_M = 0.14
FRONT, BOTTOM = synthetic_camera.info_of("front"), synthetic_camera.info_of("bottom")
AHEAD = (1.0, 0.0, 0.0)


def seen(direction: Any, range_m: float = 4.1, sigma_rad: float = 0.005, sigma_m: float = 0.2) -> Seen:
    unit: Any = tuple((np.array(direction) / np.linalg.norm(direction)).tolist())
    return Seen(direction_B=unit, range_m=range_m, sigma_direction_rad=sigma_rad, sigma_range_m=sigma_m)


def sightings(t_ns: int) -> Sightings:
    return Sightings(t_ns=t_ns, seq=0, t_sample_ns=t_ns, camera="front", seen=(seen(AHEAD),))


def changed(info: CameraInfo, **fields: Any) -> CameraInfo:
    return msgspec.structs.replace(info, **fields)


def test_what_is_straight_ahead_is_in_the_middle_of_the_front_picture():
    (mark,) = marks_of(FRONT, [seen(AHEAD)], HAT_M)
    assert (mark.u, mark.v) == (319.5, 179.5)
    assert mark.text == "4.1 ± 0.2 m"


@pytest.mark.parametrize(
    ("info", "direction", "left", "above"),
    [
        (FRONT, (1.0, 0.2, 0.0), True, None),  # y of B is to the left
        (FRONT, (1.0, -0.2, 0.0), False, None),
        (FRONT, (1.0, 0.0, 0.2), None, True),
        (BOTTOM, (0.2, 0.0, -1.0), None, True),  # ahead is at the top of the bottom picture
        (BOTTOM, (0.0, 0.2, -1.0), True, None),
    ],
)
def test_sides_are_those_of_the_body(info: CameraInfo, direction: Any, left: bool | None, above: bool | None):
    (mark,) = marks_of(info, [seen(direction)], HAT_M)
    du, dv = mark.u - (info.width - 1) / 2, mark.v - (info.height - 1) / 2
    assert (du < -10) is bool(left) if left is not None else abs(du) < 0.1
    assert (dv < -10) is bool(above) if above is not None else abs(dv) < 0.1


@pytest.mark.parametrize("direction", [(-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 3.0, 0.0), (0.0, 0.0, -1.0)])
def test_what_the_picture_does_not_show_has_no_mark(direction: Any):
    assert marks_of(FRONT, [seen(direction)], HAT_M) == ()


def test_a_turned_quaternion_of_any_length_turns_the_camera():
    half = math.radians(90) / 2  # the front camera looks to the left
    w, x, y, z = FRONT.orientation_wxyz
    c, s = math.cos(half), math.sin(half)
    turned: Any = tuple(3.0 * q for q in (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w))
    (mark,) = marks_of(changed(FRONT, orientation_wxyz=turned), [seen((0.0, 1.0, 0.0))], HAT_M)
    assert (mark.u, mark.v) == (319.5, 179.5)


@given(y=st.floats(-0.6, 0.6), z=st.floats(-0.35, 0.35))
def test_marks_fall_where_opencv_projects_with_distortion(y: float, z: float):
    cv2 = pytest.importorskip("cv2", reason="pip install opencv-python-headless")
    D = (-0.12, 0.03, 0.001, -0.002, 0.0)
    info = changed(FRONT, D=D)
    ray_K = np.array([[-y, -z, 1.0]])
    expected = cv2.projectPoints(ray_K, np.zeros(3), np.zeros(3), np.array(info.K).reshape(3, 3), np.array(D))[0][0, 0]
    marks = marks_of(info, [seen((1.0, y, z))], HAT_M)
    inside = bool(np.all(expected > 0) and expected[0] < info.width - 1 and expected[1] < info.height - 1)
    assert len(marks) == 1 or not inside
    for mark in marks:
        assert (mark.u, mark.v) == pytest.approx(tuple(expected), abs=0.06)  # to a tenth of a pixel


def test_a_lens_that_folds_over_shows_nothing_from_outside_of_its_field():
    info = changed(FRONT, D=(-0.3, 0.0, 0.0, 0.0, 0.0))
    y = 1.826  # where 1 - 0.3 y² is 0: the polynomial puts it into the middle of the picture
    assert marks_of(info, [seen((1.0, y, 0.0))], HAT_M) == ()
    assert len(marks_of(info, [seen((1.0, 0.3, 0.0))], HAT_M)) == 1


def test_a_circle_is_as_large_as_the_hat_and_two_sigma():
    near, far = marks_of(FRONT, [seen(AHEAD, 2.0, 0.01), seen(AHEAD, 500.0, 0.0)], HAT_M)
    assert near.radius == pytest.approx(FRONT.K[0] * (0.07 / 2.0 + 0.02), abs=0.06)
    assert far.radius == RADIUS_MIN_PX
    (huge,) = marks_of(FRONT, [seen(AHEAD, 1e-9)], HAT_M)
    assert huge.radius == FRONT.height


@pytest.mark.parametrize("range_m", [0.0, -1.0])
def test_a_range_that_is_none_has_no_mark(range_m: float):
    assert marks_of(FRONT, [seen(AHEAD, range_m)], HAT_M) == ()


@pytest.mark.parametrize(("sigma_m", "text"), [(0.2, "4.1 ± 0.2 m"), (0.04, "4.10 ± 0.04 m")])
def test_a_range_has_the_digits_of_its_sigma(sigma_m: float, text: str):
    assert range_text(seen(AHEAD, 4.1, sigma_m=sigma_m)) == text


@pytest.mark.parametrize(
    "wrong",
    [
        {"K": (0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0)},
        {"K": (1.0, 0.0, 1.0, 0.0, -1.0, 1.0, 0.0, 0.0, 1.0)},
        {"orientation_wxyz": (0.0, 0.0, 0.0, 0.0)},
    ],
)
def test_a_camera_that_cannot_be_computed_with_is_not_used(wrong: dict[str, Any]):
    assert is_usable(FRONT)
    assert not is_usable(changed(FRONT, **wrong))


def test_the_angle_of_view_is_from_top_to_bottom():
    diagonal = 2 * math.atan(math.hypot(320, 180) / FRONT.K[0])
    assert math.degrees(diagonal) == pytest.approx(92.0)
    assert field_of_view(FRONT) == pytest.approx(2 * math.atan(180 / FRONT.K[0]))


def test_sightings_of_the_pictures_time_are_taken_and_else_the_nearest():
    kept = [sightings(t_ns) for t_ns in (0, 100_000_000, 200_000_000)]
    assert sightings_of(100_000_000, kept) is kept[1]
    assert sightings_of(170_000_000, kept) is kept[2]


def test_old_sightings_are_not_drawn():
    assert sightings_of(AGE_MAX_NS, [sightings(0)]) is not None
    assert sightings_of(AGE_MAX_NS + 1, [sightings(0)]) is None
    assert sightings_of(0, [sightings(AGE_MAX_NS + 1)]) is None  # a replay has gone back
    assert sightings_of(0, []) is None
