"""Pictures of the renderer against the projection of the lens and the expected effect of each setting."""

from typing import Any

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from pictures import BOTTOM, CLEAN, FRONT, bodies, has_magenta, hat_pixel, looks, magenta_centre, renderer, scene

from zsim.math.frames import quaternion_from_rpy, rotation_matrix
from zsim.scenario.scenario import Obstacle
from zsim.scenario.surroundings import row_of
from zsim.sensors.camera import FrontCamera, Hats
from zsim.sensors.camera_model import lens_of
from zsim.sensors.sensor import Mount
from zsim_agents.cameras.renderer import Ground

CENTRE_PX = 0.5  # largest error of a hat's centre per axis, by requirement
AHEAD = bodies([(0, 0, 5), (4, 0.5, 4.6)])
BARREL = (-0.28, 0.09, 0.001, -0.001, 0.0)


def draw(camera: Any = FRONT, where: Any = AHEAD, number: int = 0, t_s: float = 1.0, **fields: Any) -> Any:
    return renderer(camera, **fields).picture(number, t_s, where)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BARREL])
def test_a_hat_is_drawn_where_the_lens_projects_it(distortion: Any) -> None:
    camera = FrontCamera(**CLEAN, distortion=distortion)
    drawn = renderer(camera)
    found = 0
    for look in looks(40, seed=2, ranges_m=(2.5, 12.0)):
        u, v = hat_pixel(camera, look.where)
        if 15 < u < camera.width_px - 15 and 15 < v < camera.height_px - 15:
            off = magenta_centre(drawn.picture(0, 1.0, look.where)) - (u, v)
            assert np.abs(off).max() < CENTRE_PX, (u, v)
            found += 1
    assert found > 25


TURNED = Mount(position_m=(0.1, -0.05, 0.06), rpy_deg=(20.0, -10.0, 15.0))


@pytest.mark.parametrize(
    ("camera", "where"),
    [
        (FrontCamera(**CLEAN, mount=TURNED), bodies([(0, 0, 5), (4, 1.3, 4.4)], [(0.1, 0.05, 0.1), (0, 0, 2)])),
        (replace(BOTTOM, **CLEAN), bodies([(0, 0, 8), (0.5, -0.4, 5)])),
    ],
    ids=["turned and shifted", "bottom"],
)
def test_a_hat_is_drawn_where_other_cameras_project_it(camera: Any, where: Any) -> None:
    assert np.abs(magenta_centre(draw(camera, where)) - hat_pixel(camera, where)).max() < CENTRE_PX


def test_pictures_are_determined_by_their_inputs_seed_and_number() -> None:
    drawn = renderer()
    first = drawn.picture(0, 1.0, AHEAD).copy()
    drawn.picture(1, 1.1, bodies([(0, 0, 2), (2, 0.5, 2)], [(0.3, 0.2, 0.5), (0, 0, 0)]))
    assert (drawn.picture(0, 1.0, AHEAD) == first).all()  # it is independent of earlier pictures
    assert (draw() == first).all()
    assert (draw(number=1) != first).any()
    assert (draw(seed=2) != first).any()


def test_noise_has_the_configured_standard_deviation() -> None:
    sky = np.s_[:60, 100:500]
    clean, noisy = (draw(FrontCamera(noise=noise, blur_px=0.0))[sky].astype(float) for noise in (0.0, 4.0))
    assert (noisy - clean).std() == pytest.approx(4.0, rel=0.05)
    assert (noisy - clean).mean() == pytest.approx(0.0, abs=0.1)


def test_less_light_makes_a_darker_and_noisier_picture() -> None:
    sky = np.s_[:60, 100:500]
    day, dusk = (draw(of=scene(light=light))[sky].astype(float) for light in (1.0, 0.09))
    rough = [np.diff(each, axis=1).std() for each in (day, dusk)]
    assert dusk.mean() == pytest.approx(0.3 * day.mean(), rel=0.1)
    assert rough[1] == pytest.approx(rough[0] / 0.3, rel=0.1)


def test_a_body_rate_blurs_only_along_its_motion() -> None:
    camera = FrontCamera(**CLEAN, exposure_ms=20.0)
    still, turning = (draw(camera, bodies(AHEAD.p_WB, w_B=[(0, 0, rate), (0, 0, 0)])) for rate in (0.0, 1.5))
    (u, v), way_px = hat_pixel(camera, AHEAD), lens_of(camera).fx * 1.5 * 0.02
    spread = [magenta_spread(picture) for picture in (still, turning)]
    widened = spread[1] ** 2 - spread[0] ** 2
    assert widened[0] == pytest.approx(way_px**2 / 12, rel=0.35)  # variance of a uniform distribution
    assert abs(widened[1]) < 0.1 * widened[0]
    assert np.abs(magenta_centre(turning) - (u, v)).max() < CENTRE_PX


def magenta_spread(picture: Any) -> np.ndarray:
    weight = np.clip(picture[..., 2].astype(float) - picture[..., 1], 0, None)  # negative for hull and grass
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    middle = [(weight * at).sum() / weight.sum() for at in (u, v)]
    return np.sqrt([(weight * (at - m) ** 2).sum() / weight.sum() for at, m in zip((u, v), middle, strict=True)])


def test_the_ground_is_blurred_by_the_speed_over_it() -> None:
    camera = replace(BOTTOM, **CLEAN, exposure_ms=30.0)
    still, fast = (
        draw(camera, bodies([(3, 2, 1.5), (9, 9, 9)], v_W=[(speed, 0, 0), (0, 0, 0)])) for speed in (0.0, 3.0)
    )
    along, across = (np.abs(np.diff(fast.astype(int), axis=axis)).mean() for axis in (0, 1))
    assert along < 0.75 * np.abs(np.diff(still.astype(int), axis=0)).mean()  # ahead is upwards in the picture
    assert along < across


@pytest.mark.parametrize(
    ("obstacle", "hides"),
    [
        ({"shape": "box", "position_m": (2, 0, 0), "size_m": (0.2, 6, 9)}, True),
        ({"shape": "box", "position_m": (7, 0, 0), "size_m": (0.2, 6, 9)}, False),
        ({"shape": "cylinder", "position_m": (2.0, 0.27, 0.0), "radius_m": 0.6, "height_m": 9.0}, True),
        ({"shape": "sphere", "position_m": (2.0, 0.27, 4.8), "radius_m": 0.8}, True),
    ],
)
def test_an_obstacle_hides_only_hats_behind_it(obstacle: Any, hides: bool) -> None:
    row = tuple(row_of(Obstacle(name="wall", **obstacle)))
    assert has_magenta(draw(of=scene(obstacles=(row,)))) is not hides


@pytest.mark.parametrize("lens", [{}, {"distortion": (-0.2, 0.05, 0, 0, 0)}], ids=["flat", "bent"])
def test_a_surface_seen_from_either_side_hides_only_hats_behind_it(lens: dict[str, Any]) -> None:
    for x, hides in ((2.0, True), (7.0, False)):
        a, b, c = (x, -9.0, 0.0), (x, 9.0, 0.0), (x, 0.0, 20.0)
        for corners in ((a, b, c), (a, c, b)):
            first, *others = np.array(corners)
            row = np.concatenate([first, *(other - first for other in others)])[None]
            picture = draw(replace(FRONT, **CLEAN, **lens), of=scene()._replace(surfaces=row))
            assert has_magenta(picture) is not hides


def test_a_nearer_drone_hides_the_hat_of_a_farther_one() -> None:
    far = bodies([(0, 0, 5), (6, 0, 5), (1.2, 0, 5.02)])
    covered = scene(3)._replace(drones=(*scene(2).drones, scene(1).drones[0]._replace(has_hat=False)))
    assert has_magenta(draw(where=bodies([(0, 0, 5), (6, 0, 5), (60, 0, 5.02)]), of=covered))
    assert not has_magenta(draw(where=far, of=covered))


def test_a_covered_hat_is_not_drawn_and_a_false_one_is() -> None:
    bare = scene()._replace(drones=tuple(look._replace(has_hat=False) for look in scene().drones))
    assert not has_magenta(draw(of=bare))
    false = draw(FrontCamera(**CLEAN), of=bare._replace(hats=Hats(false_m=[(5.0, -1.0, 4.0)])))
    assert np.abs(magenta_centre(false) - hat_pixel(FRONT, bodies([(0, 0, 5), (5.03, -1.0, 3.89)]))).max() < CENTRE_PX


def test_rotors_turn_between_two_pictures() -> None:
    near = bodies([(0, 0, 5), (1.2, 0, 4.7)])
    camera = FrontCamera(**CLEAN, exposure_ms=1.0)
    assert (draw(camera, near, t_s=1.0) != draw(camera, near, t_s=1.003)).any()
    still = near._replace(rotors=[[0.0] * 4] * 2)
    assert (draw(camera, still, t_s=1.0) == draw(camera, still, t_s=1.003)).all()


@pytest.mark.parametrize("rpy", [(0, 0, 0), (1.2, 0, 0), (0, 1.5, 0), (3.1, 0, 0), (0.4, -1.5, 2)])
@pytest.mark.parametrize("height_m", [0.0, 0.5, 30.0, 900.0])
def test_any_attitude_and_height_gives_a_picture(rpy: Any, height_m: float) -> None:
    picture = draw(where=bodies([(1e4, -3e3, height_m), (1e4 + 0.1, -3e3, height_m)], [rpy, rpy]))
    assert picture.shape == (FRONT.height_px, FRONT.width_px, 3)


# A checkerboard on the ground: OpenCV's calibration is the reference

SQUARE_M, INNER = 0.15, (8, 6)


def board() -> Ground:
    tile = np.full((1000, 1000), 150, np.uint8)
    side = round(SQUARE_M / 0.005)
    for i in range(INNER[0] + 1):
        for j in range(INNER[1] + 1):
            if (i + j) % 2 == 0:
                u, v = 500 + side * (i - 4), 500 + side * (j - 3)
                tile[v : v + side, u : u + side] = 0
    return Ground(tile, texel_m=0.005)


@pytest.mark.parametrize("distortion", [pytest.param((0.0,) * 5, marks=pytest.mark.soak), (-0.2, 0.05, 0.0, 0.0, 0.0)])
def test_checkerboard_calibration_recovers_the_stated_intrinsics(distortion: Any) -> None:
    down = Mount(rpy_deg=(0.0, 90.0, 0.0))
    camera = FrontCamera(noise=1.0, mount=down, distortion=distortion)
    drawn = renderer(camera, scene(1), ground=board())
    rng = np.random.default_rng(5)
    corners = []
    for _ in range(40):
        tilt, height = rng.uniform(-0.6, 0.6, 2), rng.uniform(1.1, 1.8)
        rpy = (*tilt, rng.choice([0.0, rng.uniform(-3, 3)]))
        x, y, z = rotation_matrix(quaternion_from_rpy(rpy)) @ (0, 0, -height)
        place = np.array([-x, -y]) * height / -z + rng.uniform(-0.25, 0.25, 2)  # the board is near the centre
        grey = cv2.cvtColor(drawn.picture(0, 1.0, bodies([(*place, height)], [rpy])), cv2.COLOR_BGR2GRAY)
        is_there, found = cv2.findChessboardCornersSB(grey, INNER)
        if is_there:
            corners.append(found)
    assert len(corners) >= 15
    grid = np.zeros((INNER[0] * INNER[1], 3), np.float32)
    grid[:, :2] = SQUARE_M * np.mgrid[: INNER[0], : INNER[1]].T.reshape(-1, 2)
    size = (camera.width_px, camera.height_px)
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    rms, K, D, _, _ = cv2.calibrateCamera([grid] * len(corners), corners, size, None, None, flags=flags)
    lens = lens_of(camera)
    assert rms < 0.2
    for found, stated in ((K[0, 0], lens.fx), (K[1, 1], lens.fy), (K[0, 2], lens.cx), (K[1, 2], lens.cy)):
        assert found == pytest.approx(stated, rel=0.005)
    assert D.ravel()[0] == pytest.approx(distortion[0], abs=0.01)


def test_the_lines_of_the_meadow_are_a_metre_apart() -> None:
    camera = replace(BOTTOM, **CLEAN)
    grey = draw(camera, bodies([(0.5, 0.5, 4.0), (50, 50, 50)])).astype(float).sum(axis=-1)
    profile = grey.mean(axis=0)  # south is to the right
    lens = lens_of(camera)
    height_m = 4.0 + camera.mount.position_m[2]
    at = [round(lens.cx + lens.fx * offset / height_m) for offset in (-0.5, 0.5)]
    for u in at:
        near = profile[u - 12 : u + 13]
        assert abs(int(near.argmax()) - 12) <= 1
