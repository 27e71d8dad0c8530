"""The lens: rays to pixels and back, lenses that fold a picture, and invalid camera settings."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
from refused import faulty_fields

from zsim.sensors.camera import FrontCamera
from zsim.sensors.camera_model import camera_matrix, distorted, distortion_slopes, folds, lens_of, undistorted

SOUND = [
    (92.0, (-0.13, 0.0, 0.0, 0.0, 0.0)),
    (92.0, (-0.28, 0.09, 0.001, -0.002, 0.0)),
    (150.0, (-0.25, 0.08, 0.0, 0.0, 0.0)),
    (92.0, (0.3, 0.1, 0.0, 0.0, 0.0)),
    (92.0, (10.0, 0.0, 0.0, 0.0, 0.0)),
]
FOLDING = [
    (92.0, (-0.14, 0.0, 0.0, 0.0, 0.0)),
    (92.0, (-5.0, 0.0, 0.0, 0.0, 0.0)),
    (92.0, (1e9, 0.0, 0.0, 0.0, 0.0)),
    (92.0, (0.0, -1.0, 0.0, 0.0, 0.0)),
    (92.0, (0.0, 0.0, 1.0, 0.0, 0.0)),
]
DRONES = [{"name": "d1", "position_m": [0, 0, 0]}]


def camera(diagonal_deg: float, distortion: Any) -> FrontCamera:
    return FrontCamera(diagonal_deg=diagonal_deg, distortion=distortion)


@pytest.mark.parametrize(("diagonal_deg", "distortion"), SOUND)
def test_the_ray_of_a_pixel_projects_back_onto_it(diagonal_deg: float, distortion: Any) -> None:
    """Checked with OpenCV's projection over the whole picture, including its corners."""
    lens = lens_of(camera(diagonal_deg, distortion))
    u, v = (
        each.ravel() for each in np.meshgrid(np.linspace(0, lens.width - 1, 41), np.linspace(0, lens.height - 1, 23))
    )
    x, y = undistorted(lens, u, v)
    points = np.column_stack([x, y, np.ones_like(x)])
    falls, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera_matrix(lens), np.array(distortion))
    assert falls[:, 0] == pytest.approx(np.column_stack([u, v]), abs=1e-6)
    assert not folds(lens)


@pytest.mark.parametrize(("diagonal_deg", "distortion"), SOUND)
def test_the_distortion_slopes_match_finite_differences(diagonal_deg: float, distortion: Any) -> None:
    lens, h = lens_of(camera(diagonal_deg, distortion)), 1e-6
    for x, y in ((0.3, -0.2), (-0.5, 0.4), (0.0, 0.0)):
        by_x = [(a - b) / (2 * h) for a, b in zip(distorted(lens, x + h, y), distorted(lens, x - h, y), strict=True)]
        by_y = [(a - b) / (2 * h) for a, b in zip(distorted(lens, x, y + h), distorted(lens, x, y - h), strict=True)]
        xx, xy, yy = distortion_slopes(lens, x, y)
        assert (xx, xy, xy, yy) == pytest.approx((by_x[0], by_x[1], by_y[0], by_y[1]), abs=1e-7)


@pytest.mark.parametrize(("diagonal_deg", "distortion"), FOLDING)
def test_a_lens_that_folds_the_picture_is_detected(diagonal_deg: float, distortion: Any) -> None:
    assert folds(lens_of(camera(diagonal_deg, distortion)))


def test_k1_alone_folds_if_its_cubic_turns_back_before_the_corner() -> None:
    least = -4 / 27 / math.tan(math.radians(46)) ** 2
    found = [folds(lens_of(camera(92.0, (k1, 0.0, 0.0, 0.0, 0.0)))) for k1 in (least * 0.99, least * 1.01)]
    assert found == [False, True]


@pytest.mark.parametrize(
    ("sensors", "path"),
    [
        ({"front_camera": {"distortion": [-5, 0, 0, 0, 0]}}, "drones[0].sensors.front_camera.distortion"),
        ({"bottom_camera": {"exposure_ms": 20}}, "drones[0].sensors.bottom_camera.exposure_ms"),
        ({"front_camera": {}, "sightings": {"cameras": ["front", "front"]}}, "drones[0].sensors.sightings.cameras[1]"),
        ({"sightings": {}}, "drones[0].sensors.sightings.cameras[0]"),
    ],
)
def test_invalid_settings_are_refused_with_their_path(sensors: dict[str, Any], path: str) -> None:
    assert faulty_fields({"name": "t", "duration_s": 1, "drones": DRONES, "sensors": sensors}) == [path]
