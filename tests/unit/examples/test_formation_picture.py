"""examples/formation_picture.py: all drones of any formation are in the picture."""

import formation_picture
import numpy as np
import pytest
from formation_picture import CAMERA, Instant, follower, picture, sides

from zsim.math.frames import quaternion_from_heading, rotation_matrix
from zsim.sensors.camera_model import camera_pose, lens_of
from zsim_agents.cameras.scene import DroneStates, Scene, View, camera_motion, default_look


def formation(count: int, radius_m: float, height_m: float, turn_rad: float = 0.0) -> DroneStates:
    """Return drones that hover on a circle around (50, -20) m."""
    angles = turn_rad + np.arange(count) * 2 * np.pi / count
    p_WB = np.stack([50 + radius_m * np.cos(angles), -20 + radius_m * np.sin(angles), np.full(count, height_m)], axis=1)
    none = np.zeros((count, 3))
    return DroneStates(p_WB, none, quaternion_from_heading(angles), none, [[300.0] * 4] * count)


@pytest.fixture(scope="module")
def view() -> View:
    return View(lens_of(CAMERA))


@pytest.mark.parametrize("turn_rad", [0.0, 0.7, 1.4])
@pytest.mark.parametrize(("count", "radius_m", "height_m"), [(2, 1.0, 3.0), (3, 2.3, 15.0), (30, 40.0, 60.0)])
def test_all_drones_are_in_the_picture_of_the_following_camera(
    view: View, count: int, radius_m: float, height_m: float, turn_rad: float
) -> None:
    bodies = follower(formation(count, radius_m, height_m, turn_rad))
    motion = camera_motion(camera_pose(CAMERA), bodies, rotation_matrix(bodies.q_WB[count]), count)
    points_K = motion.points_K(bodies.p_WB[:count])
    assert (points_K[:, 2] > 0).all()
    pixels = view.pixels(points_K)
    assert (pixels > 0).all()
    assert (pixels < (CAMERA.width_px, CAMERA.height_px)).all()


def test_the_hats_of_all_drones_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formation_picture, "label", lambda *_: None)
    states = formation(3, 2.3, 15.0)
    drawn = picture(Instant(["drone1", "drone2", "drone3"], Scene((default_look(),) * 3), states), 0.0)
    blue, green, red = np.moveaxis(drawn.astype(int), -1, 0)
    magenta = (red > 150) & (green < 60) & (blue > 80)
    assert magenta.sum() > 3 * 200  # px; the nearest hat alone has more
    columns = np.flatnonzero(magenta.any(axis=0))
    assert np.ptp(columns) > CAMERA.width_px / 3


def test_the_sides_are_those_of_the_polygon() -> None:
    assert sides(2) == [(0, 1)]
    assert sides(3) == [(0, 1), (1, 2), (2, 0)]
