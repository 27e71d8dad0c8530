"""The detector on pictures with known truth: bearing, range, and consistency of the stated sigmas."""

from typing import Any

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from pictures import BOTTOM, FRONT, HATS, bodies, hat_K, looks, renderer, scene
from refused import has_terms

from zsim.sensors.camera import Camera, FrontCamera, PictureError, frame_of
from zsim.sensors.camera_model import camera_pose, lens_of
from zsim_agents.cameras.detector import HatDetector, decoded
from zsim_agents.cameras.foreground import AMBIENT, ball_images
from zsim_agents.cameras.scene import View

ASSOCIATED_RAD = 0.03  # rad, largest error of direction with which a sighting is associated with the hat


def detector(camera: Camera = FRONT) -> HatDetector:
    return HatDetector(lens_of(camera), camera_pose(camera), HATS.diameter_m)


def errors(camera: Camera, count: int, seed: int, light: float = 1.0, **of_looks: Any) -> np.ndarray:
    """Return for each sighted hat its apparent diameter [px], the normalised errors of both axes of its direction and
    of its range, and the relative error of its range, (M, 5); assert that nothing else is sighted."""
    drawn, found = renderer(camera, scene(light=light)), detector(camera)
    rows = []
    for number, look in enumerate(looks(count, seed, **of_looks)):
        data = drawn.jpeg(number, number / 15, look.where)
        seen = found.seen(decoded(data, camera.width_px, camera.height_px))
        d = look.direction_B
        across = np.cross(d, (0, 0, 1)) / np.hypot(*d[:2])
        for each in seen:
            off = np.array(each.direction_B) - d
            assert np.linalg.norm(off) < ASSOCIATED_RAD, look
            axes = np.array([off @ across, off @ np.cross(d, across)]) / each.sigma_direction_rad
            miss = each.range_m - look.range_m
            size = lens_of(camera).fx * HATS.diameter_m / look.range_m
            rows.append((size, *axes, miss / each.sigma_range_m, miss / look.range_m))
    assert len(rows) <= count
    return np.array(rows)


def test_range_and_bearing_are_consistent_with_their_sigmas() -> None:
    of_all = errors(FRONT, 220, seed=3)
    assert len(of_all) > 205
    assert 0.7 < np.sqrt((of_all[:, 1:3] ** 2).mean()) < 1.3
    assert 0.7 < np.sqrt((of_all[:, 3] ** 2).mean()) < 1.3


@pytest.mark.parametrize(
    ("ranges_m", "rms"), [((1.2, 2.5), 0.02), ((2.5, 5.0), 0.04), ((5.0, 8.0), 0.06), ((8.0, 12.0), 0.15)]
)
def test_the_relative_error_of_the_range_is_bounded(ranges_m: Any, rms: float) -> None:
    of_all = errors(FRONT, 60, seed=4, ranges_m=ranges_m)
    assert len(of_all) > 50
    assert np.sqrt((of_all[:, 4] ** 2).mean()) < rms


@pytest.mark.parametrize(
    ("camera", "fields"),
    [
        (FRONT, {"light": 0.15}),
        (FRONT, {"rate_rad_s": 0.7}),
        (FrontCamera(distortion=(-0.28, 0.09, 0.0, 0.0, 0.0)), {}),
    ],
)
def test_sigmas_hold_at_dusk_in_rotation_and_with_distortion(camera: Camera, fields: Any) -> None:
    of_all = errors(camera, 120, seed=5, ranges_m=(1.5, 6.0), **fields)
    assert len(of_all) > 100
    assert np.sqrt((of_all[:, 1:3] ** 2).mean()) < 1.4
    assert np.sqrt((of_all[:, 3] ** 2).mean()) < 1.4


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.8, 0.0), (-0.78, 0.38)])
def test_a_ball_anywhere_in_the_picture_is_measured_correctly(place: Any) -> None:
    lens, distance = lens_of(FRONT), 2.0
    direction_K = np.array([*place, 1.0]) / np.linalg.norm([*place, 1.0])
    picture = np.full((lens.height, lens.width, 3), 90, np.uint8)
    colour = np.array([134.0, 0.0, 226.0]) / AMBIENT  # uniform shade, so that only geometry matters
    centres, radius_m = (direction_K * distance)[None], HATS.diameter_m / 2
    ball_images(View(lens), centres, np.zeros((1, 3)), radius_m, colour, direction_K)[0].draw(picture)
    (seen,) = detector().seen(picture)
    off = np.array(seen.direction_B) - camera_pose(FRONT).R_BK @ direction_K
    assert np.linalg.norm(off) < 5e-4  # 0.2 px
    assert seen.range_m == pytest.approx(distance, rel=0.02)


def test_the_bottom_camera_sees_drones_below() -> None:
    where = bodies([(0, 0, 8), (0.5, -0.4, 4.5)])
    (seen,) = detector(BOTTOM).seen(renderer(BOTTOM).picture(0, 1.0, where))
    found_K = camera_pose(BOTTOM).R_BK.T @ np.array(seen.direction_B) * seen.range_m
    assert found_K == pytest.approx(hat_K(BOTTOM, where), abs=4 * seen.sigma_range_m)


def test_exactly_the_hats_of_a_formation_are_seen() -> None:
    where = bodies([(0, 0, 6), (4, 1.5, 5.5), (6, -2, 5.0), (5, 0, 4.0)])
    seen = detector().seen(renderer(FRONT, scene(4)).picture(0, 1.0, where))
    R_KB = camera_pose(FRONT).R_BK.T
    off = [
        min(float(np.linalg.norm(R_KB @ s.direction_B - k / np.linalg.norm(k))) for s in seen)
        for k in (hat_K(FRONT, where, i) for i in (1, 2, 3))
    ]
    assert len(seen) == 3
    assert max(off) < 2e-3


def test_nothing_is_seen_without_a_hat() -> None:
    drawn = renderer(FRONT, scene(1))
    for yaw in np.linspace(-3, 3, 12):
        assert detector().seen(drawn.picture(0, 1.0, bodies([(2, 3, 4)], [(0.1, -0.1, yaw)]))) == ()


def test_a_hat_cut_by_the_edge_or_too_small_is_omitted() -> None:
    drawn, edge = renderer(replace(FRONT, noise=0.0)), 320 / lens_of(FRONT).fx  # tangent of the angle to the edge
    assert detector().seen(drawn.picture(0, 1.0, bodies([(0, 0, 5), (2.16, 2 * edge, 4.8)]))) == ()
    seen = [detector().seen(drawn.picture(0, 1.0, bodies([(0, 0, 5), (away, 0, 4.5)]))) for away in (8, 18)]
    assert [*map(len, seen)] == [1, 0]


@pytest.mark.parametrize("kind", ["noise", "magenta", "black", "stripes"])
def test_any_picture_is_processed(kind: str) -> None:
    shape = FRONT.height_px, FRONT.width_px, 3
    picture = np.zeros(shape, np.uint8)
    if kind == "noise":
        picture = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    elif kind == "magenta":
        picture[:] = (134, 0, 226)
    elif kind == "stripes":
        picture[::8] = picture[1::8] = (134, 0, 226)
    for seen in detector().seen(picture):
        assert np.isfinite([*seen.direction_B, seen.range_m, seen.sigma_range_m, seen.sigma_direction_rad]).all()


def test_balls_of_other_colours_are_not_hats() -> None:
    picture = np.full((360, 640, 3), 120, np.uint8)
    for i, colour in enumerate([(24, 108, 240), (20, 20, 220), (30, 200, 220), (220, 60, 40), (60, 180, 60)]):
        cv2.circle(picture, (80 + 100 * i, 180), 12, colour, cv2.FILLED, cv2.LINE_AA)
    assert detector().seen(picture) == ()


# Foreign JPEG data

PICTURE = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)


def jpeg(*options: int) -> bytes:
    return cv2.imencode(".jpg", PICTURE, [*options])[1].tobytes()


@pytest.mark.parametrize(
    "options",
    [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 2), (cv2.IMWRITE_JPEG_QUALITY, 5)],
)
def test_the_size_of_any_jpeg_is_read(options: tuple[int, ...]) -> None:
    assert frame_of(jpeg(*options))[1:] == (64, 48)
    assert decoded(jpeg(*options), 64, 48).shape == (48, 64, 3)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8",
        b"\xff\xd8\xff\xd9",
        b"\xff\xd8\xff\xc0\x00",
        b"\xff\xd8\xff\xe0\x00\x00" * 9,
        b"\xff\xd8" + b"\xff" * 500,
        b"\x89PNG\r\n\x1a\n" + bytes(100),
        bytes(range(256)) * 4,
        cv2.imencode(".png", PICTURE)[1].tobytes(),
        jpeg()[:20],
    ],
)
def test_invalid_jpeg_data_is_refused(data: bytes) -> None:
    with pytest.raises(PictureError):
        decoded(data, 64, 48)


def test_truncated_and_corrupt_jpegs_are_decoded_or_refused_in_one_line() -> None:
    data, rng = jpeg(), np.random.default_rng(2)
    pictures = [data[:end] for end in range(0, len(data), 37)]
    for _ in range(100):
        noisy = bytearray(data)
        for at in rng.integers(2, len(data), 5):
            noisy[at] = rng.integers(256)
        pictures.append(bytes(noisy))
    refusals = []
    for picture in pictures:
        try:
            assert decoded(picture, 64, 48).shape == (48, 64, 3)
        except PictureError as error:
            refusals.append(str(error))
    assert not [refusal for refusal in refusals if "\n" in refusal]


def test_an_absurd_size_in_a_header_is_refused_before_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
    data = bytearray(jpeg())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = b"\xff\xff\xff\xff"
    with pytest.raises(PictureError) as caught:
        decoded(bytes(data), 64, 48)
    assert has_terms(str(caught.value), "65535", "64", "48")
    with pytest.raises(PictureError) as caught:
        decoded(bytes(data), 65535, 65535)
    assert has_terms(str(caught.value), str(65535**2))
