"""The camera feed of the console: subscriptions while a page watches, checks of pictures, and marks on them."""

import io
import json
import math
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import synthetic_camera
from hypothesis import given
from hypothesis import strategies as st
from refused import has_terms, refused

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraInfo, Seen, Sightings
from zsim.errors import SessionError
from zsim.sensors.camera import PictureError, frame_of
from zsim_bridges.console.camera_feed import (
    AGE_MAX_NS,
    PICTURE_BYTES_MAX,
    RADIUS_MIN_PX,
    REQUEST_EXPIRY_S,
    SIGHTINGS_KEPT,
    CameraFeed,
    check_picture,
    field_of_view,
    marks_of,
    range_text,
    sightings_of,
)
from zsim_bridges.console.page_sockets import PageBatches

FRONT, BOTTOM = "drone1/front", "drone1/bottom"
PAGE = "a page"
JPEG = {name: synthetic_camera.picture(name, 1) for name in ("front", "bottom")}


class Link:
    """A session on which only the test publishes."""

    def __init__(self) -> None:
        self.subscribed: dict[str, Callable[[Any], None]] = {}
        self.kept: list[Any] = []
        self.refusal: Exception | None = None

    def declare_subscriber(self, expression: str, callback: Callable[[Any], None]) -> Callable[[], None]:
        assert expression not in self.subscribed
        self.subscribed[expression] = callback
        return lambda: self.subscribed.pop(expression) and None

    def get(self, expression: str) -> list[Any]:
        if self.refusal is not None:
            raise self.refusal
        return [sample for sample in self.kept if keys.matches(expression, sample.key)]

    def pictures(self) -> set[str]:
        return {key for key in self.subscribed if keys.is_picture(key)}


class Run:
    """A camera feed and the messages published to it."""

    def __init__(self) -> None:
        self.link = Link()
        self.health = SimpleNamespace(received=0, refused=0)
        self.wall_s = 100.0
        link: Any = self.link
        observer: Any = SimpleNamespace(health=self.health)
        self.feed = CameraFeed(link, observer, ["drone1", "drone2"], 0.14, lambda: self.wall_s)

    def say(self, key: str, message: Any) -> None:
        """Publish a message, or bytes, to all matching subscribers."""
        payload = message if isinstance(message, bytes) else messages.encode(message)
        for expression, callback in list(self.link.subscribed.items()):
            if keys.matches(expression, key):
                callback(SimpleNamespace(key=key, payload=payload))

    def say_infos(self, drone: str = "drone1") -> None:
        for name in ("front", "bottom"):
            self.say(keys.camera_info(drone, name), synthetic_camera.info_of(name))

    def say_picture(self, name: str = "front", t_ns: int = 0, data: bytes | None = None, **changes: Any) -> None:
        message = synthetic_camera.image_message(name, 1, JPEG[name] if data is None else data, t_ns)
        self.say(keys.camera("drone1", name), msgspec.structs.replace(message, **changes))

    def watch(self, *cameras: str) -> None:
        self.feed.request_pictures(PAGE, cameras)
        self.feed.update()


@pytest.fixture
def run() -> Run:
    made = Run()
    made.feed.open()
    return made


@pytest.fixture
def watched(run: Run) -> Run:
    run.say_infos()
    run.watch(FRONT, BOTTOM)
    return run


def batch(made: PageBatches, feed: CameraFeed, *want: str) -> tuple[dict[str, Any], bytes]:
    """Return the header and the pictures of the next message to a page."""
    data = made.next(feed, want)
    assert data is not None
    end = 4 + int.from_bytes(data[:4], "big")
    return json.loads(data[4:end]), data[end:]


# Subscriptions


def test_only_cameras_watched_by_a_page_are_subscribed_to(run: Run):
    run.watch(FRONT)
    assert list(run.link.subscribed) == [keys.camera_info("*", "*")]
    assert run.feed.cameras() == ()
    assert PageBatches().next(run.feed, ()) is None
    run.feed.release(PAGE)
    run.say_infos()
    run.feed.update()
    assert [name for name, _ in run.feed.cameras()] == [FRONT, BOTTOM]
    assert run.link.pictures() == set()
    run.say_infos("drone2")
    run.watch(FRONT)
    assert run.link.pictures() == {"drone/drone1/camera/front"}
    run.watch("drone2/bottom")
    assert run.link.pictures() == {"drone/drone2/camera/bottom"}
    run.feed.release(PAGE)
    run.feed.update()
    assert list(run.link.subscribed) == [keys.camera_info("*", "*")]


def test_subscriptions_end_when_pages_close_or_fall_silent(watched: Run):
    watched.feed.request_pictures("another", [FRONT])
    watched.feed.release(PAGE)
    for later_s, keys_left in ((REQUEST_EXPIRY_S - 0.1, {"drone/drone1/camera/front"}), (0.1, set())):
        watched.wall_s += later_s
        watched.feed.update()
        assert watched.link.pictures() == keys_left
    watched.watch(FRONT)
    watched.feed.close()
    assert watched.link.pictures() == set()


def test_earlier_cameras_are_queried_if_permitted():
    run = Run()
    for drone in ("drone1", "stranger"):
        payload = messages.encode(synthetic_camera.info_of("front"))
        run.link.kept.append(SimpleNamespace(key=keys.camera_info(drone, "front"), payload=payload))
    run.feed.open()
    assert [name for name, _ in run.feed.cameras()] == [FRONT]

    run = Run()
    run.link.refusal = SessionError("may not ask")
    run.feed.open()
    run.say_infos()
    assert len(run.feed.cameras()) == 2


@pytest.mark.parametrize(
    "wrong",
    [
        b"",
        b"\x00",
        {"orientation_wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"K": (0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0)},
        {"K": (1.0, 0.0, 1.0, 0.0, -1.0, 1.0, 0.0, 0.0, 1.0)},
    ],
)
def test_an_unusable_camera_is_counted(run: Run, wrong: Any):
    message = changed(FRONT_INFO, **wrong) if isinstance(wrong, dict) else wrong
    run.say(keys.camera_info("drone1", "front"), message)
    assert run.feed.cameras() == ()
    assert run.health.refused == 1


# Pictures


def test_the_newest_picture_is_shown_unchanged(watched: Run):
    assert watched.feed.picture(FRONT) is None
    watched.say_picture(t_ns=1)
    watched.say_picture(t_ns=2)
    shown = watched.feed.picture(FRONT)
    assert shown is not None
    assert (shown.image.t_ns, shown.image.data) == (2, JPEG["front"])
    assert watched.feed.picture(FRONT) is shown
    assert watched.feed.picture(BOTTOM) is None


BAD = {
    "no JPEG": {"data": b"GIF89a, and so on"},
    "cut off": {"data": JPEG["front"][:-500]},
    "another size": {"width": 32},
    "too many pixels": {"data": JPEG["front"], "width": 16_000, "height": 16_000},
    "too many bytes": {"data": JPEG["front"] + bytes(PICTURE_BYTES_MAX + 2000)},
}


@pytest.mark.parametrize("changes", BAD.values(), ids=BAD)
def test_a_bad_picture_is_skipped_and_counted_without_side_effects(watched: Run, changes: dict[str, Any]):
    watched.say_picture(t_ns=1)
    watched.say_picture("bottom", t_ns=1)
    good = watched.feed.picture(FRONT), watched.feed.picture(BOTTOM)
    watched.say_picture(t_ns=2, **changes)
    assert (watched.feed.picture(FRONT), watched.feed.picture(BOTTOM)) == good
    assert watched.health.refused == 1
    front, bottom = watched.feed.state()
    assert (front["refused"], bottom["refused"]) == (1, 0)
    assert has_terms(front["reason"], "must")
    watched.say_picture(t_ns=3)
    shown = watched.feed.picture(FRONT)
    assert shown is not None
    assert shown.image.t_ns == 3


@pytest.mark.parametrize("key", [keys.camera("drone1", "front"), keys.detections("drone1")])
@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80"])
def test_undecodable_messages_are_counted(watched: Run, key: str, payload: bytes):
    watched.say(key, payload)
    assert watched.feed.picture(FRONT) is None
    assert watched.health.refused == 1


def test_an_oversized_picture_is_refused_on_receipt(watched: Run):
    watched.say(keys.camera("drone1", "front"), bytes(PICTURE_BYTES_MAX + 2000))
    assert watched.feed.state()[0]["refused"] == 1  # before it is decoded


# Sightings


def detected(run: Run, t_ns: int, key: str = keys.detections("drone1")) -> None:
    run.say(key, synthetic_camera.sightings_message(1, t_ns))


def test_sightings_at_the_time_of_the_picture_are_drawn_on_it(watched: Run):
    watched.say_picture(t_ns=1_000_000_000)
    assert watched.feed.marks(FRONT) == ()
    assert watched.feed.picture(FRONT) is not None
    detected(watched, 1_000_000_000)
    (mark,) = watched.feed.marks(FRONT)
    assert (mark.u, mark.v) == pytest.approx(synthetic_camera.projected("front", synthetic_camera.HAT_B), abs=0.06)
    assert mark.text == "6.1 ± 0.2 m"
    assert watched.feed.marks(BOTTOM) == ()


def test_sightings_by_a_detector_take_precedence_over_the_world_s(watched: Run):
    watched.say_picture(t_ns=0)
    assert watched.feed.picture(FRONT) is not None
    world = msgspec.structs.replace(synthetic_camera.sightings_message(1, 0), seen=())
    detected(watched, 0, keys.sensor("drone1", keys.SIGHTINGS))
    assert len(watched.feed.marks(FRONT)) == 1
    watched.say(keys.detections("drone1"), world)
    assert watched.feed.marks(FRONT) == ()


def test_only_recent_sightings_are_kept(watched: Run):
    watched.say_picture(t_ns=0)
    assert watched.feed.picture(FRONT) is not None
    for number in range(SIGHTINGS_KEPT + 1):
        detected(watched, number * 1_000_000_000)
    assert watched.feed.marks(FRONT) == ()  # the sighting at the picture's time has been dropped


# Messages to a page


def test_a_page_gets_the_camera_list_and_the_requested_pictures(watched: Run):
    made = PageBatches()
    header, _ = batch(made, watched.feed)
    assert header["cameras"][0] == {"name": FRONT, "width": 640, "height": 360}
    watched.say_picture("front", t_ns=1_500_000_000)
    watched.say_picture("bottom")
    header, data = batch(made, watched.feed, BOTTOM, FRONT, BOTTOM)
    assert header["cameras"] is None
    assert [(each["camera"], each["size"]) for each in header["pictures"]] == [
        (BOTTOM, len(JPEG["bottom"])),
        (FRONT, len(JPEG["front"])),
    ]
    assert header["pictures"][1]["t_s"] == 1.5
    assert data == JPEG["bottom"] + JPEG["front"]


def test_only_changes_are_sent_and_late_marks_without_their_picture(watched: Run):
    made = PageBatches()
    watched.say_picture()
    watched.say_picture("bottom")
    batch(made, watched.feed, FRONT, BOTTOM)
    assert made.next(watched.feed, (FRONT, BOTTOM)) is None
    watched.say_picture(t_ns=0)
    header, data = batch(made, watched.feed, FRONT, BOTTOM)
    assert [each["camera"] for each in header["pictures"]] == [FRONT]
    assert data == JPEG["front"]
    detected(watched, 0)
    header, data = batch(made, watched.feed, FRONT)
    assert [(each["size"], len(each["marks"])) for each in header["pictures"]] == [(0, 1)]
    assert data == b""


def test_a_page_gets_an_empty_camera_list_when_a_run_is_over(watched: Run):
    made = PageBatches()
    batch(made, watched.feed)
    header, _ = batch(made, Run().feed)
    assert header == {"cameras": [], "pictures": []}


HAT_M = 0.14
FRONT_INFO, BOTTOM_INFO = synthetic_camera.info_of("front"), synthetic_camera.info_of("bottom")
AHEAD = (1.0, 0.0, 0.0)


def seen(direction: Any, range_m: float = 4.1, sigma_rad: float = 0.005, sigma_m: float = 0.2) -> Seen:
    unit: Any = tuple((np.array(direction) / np.linalg.norm(direction)).tolist())
    return Seen(direction_B=unit, range_m=range_m, sigma_direction_rad=sigma_rad, sigma_range_m=sigma_m)


def sightings(t_ns: int) -> Sightings:
    return Sightings(t_ns=t_ns, seq=0, t_sample_ns=t_ns, camera="front", seen=(seen(AHEAD),))


def changed(info: CameraInfo, **fields: Any) -> CameraInfo:
    return msgspec.structs.replace(info, **fields)


@pytest.mark.parametrize(
    ("info", "direction", "left", "above"),
    [
        (FRONT_INFO, AHEAD, None, None),
        (FRONT_INFO, (1.0, 0.2, 0.0), True, None),  # y of B is to the left
        (FRONT_INFO, (1.0, -0.2, 0.0), False, None),
        (FRONT_INFO, (1.0, 0.0, 0.2), None, True),
        (BOTTOM_INFO, (0.2, 0.0, -1.0), None, True),  # ahead is at the top of the bottom picture
        (BOTTOM_INFO, (0.0, 0.2, -1.0), True, None),
    ],
)
def test_marks_are_on_the_correct_side(info: CameraInfo, direction: Any, left: bool | None, above: bool | None):
    (mark,) = marks_of(info, [seen(direction)], HAT_M)
    du, dv = mark.u - (info.width - 1) / 2, mark.v - (info.height - 1) / 2
    assert (du < -10) is bool(left) if left is not None else abs(du) < 0.1
    assert (dv < -10) is bool(above) if above is not None else abs(dv) < 0.1


@pytest.mark.parametrize(
    ("direction", "range_m"),
    [
        ((-1.0, 0.0, 0.0), 4.1),
        ((0.0, 1.0, 0.0), 4.1),
        ((1.0, 3.0, 0.0), 4.1),
        ((0.0, 0.0, -1.0), 4.1),
        (AHEAD, 0.0),
        (AHEAD, -1.0),
    ],
)
def test_sightings_out_of_view_or_with_an_invalid_range_have_no_mark(direction: Any, range_m: float):
    assert marks_of(FRONT_INFO, [seen(direction, range_m)], HAT_M) == ()


def test_an_unnormalised_quaternion_turns_the_camera():
    half = math.radians(90) / 2  # the front camera looks to the left
    w, x, y, z = FRONT_INFO.orientation_wxyz
    c, s = math.cos(half), math.sin(half)
    turned: Any = tuple(3.0 * q for q in (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w))
    (mark,) = marks_of(changed(FRONT_INFO, orientation_wxyz=turned), [seen((0.0, 1.0, 0.0))], HAT_M)
    assert (mark.u, mark.v) == (319.5, 179.5)


@given(y=st.floats(-0.6, 0.6), z=st.floats(-0.35, 0.35))
def test_marks_agree_with_opencv_projection_under_distortion(y: float, z: float):
    cv2 = pytest.importorskip("cv2", reason="pip install opencv-python-headless")
    D = (-0.12, 0.03, 0.001, -0.002, 0.0)
    info = changed(FRONT_INFO, D=D)
    ray_K = np.array([[-y, -z, 1.0]])
    expected = cv2.projectPoints(ray_K, np.zeros(3), np.zeros(3), np.array(info.K).reshape(3, 3), np.array(D))[0][0, 0]
    marks = marks_of(info, [seen((1.0, y, z))], HAT_M)
    inside = bool(np.all(expected > 0) and expected[0] < info.width - 1 and expected[1] < info.height - 1)
    assert len(marks) == 1 or not inside
    for mark in marks:
        assert (mark.u, mark.v) == pytest.approx(tuple(expected), abs=0.06)  # marks are rounded to a tenth of a pixel


def test_a_folding_distortion_shows_nothing_outside_the_field_of_view():
    info = changed(FRONT_INFO, D=(-0.3, 0.0, 0.0, 0.0, 0.0))
    y = 1.826  # where 1 - 0.3 y² is 0: the polynomial maps it to the centre of the picture
    assert marks_of(info, [seen((1.0, y, 0.0))], HAT_M) == ()
    assert len(marks_of(info, [seen((1.0, 0.3, 0.0))], HAT_M)) == 1


def test_the_radius_of_a_mark_covers_the_hat_and_two_sigma():
    near, far = marks_of(FRONT_INFO, [seen(AHEAD, 2.0, 0.01), seen(AHEAD, 500.0, 0.0)], HAT_M)
    assert near.radius == pytest.approx(FRONT_INFO.K[0] * (0.07 / 2.0 + 0.02), abs=0.06)
    assert far.radius == RADIUS_MIN_PX
    (huge,) = marks_of(FRONT_INFO, [seen(AHEAD, 1e-9, sigma_m=0.04)], HAT_M)
    assert huge.radius == FRONT_INFO.height
    assert near.text == "2.0 ± 0.2 m"
    assert range_text(seen(AHEAD, sigma_m=0.04)) == "4.10 ± 0.04 m"  # a range has as many decimals as its sigma


def test_the_field_of_view_is_the_vertical_one():
    diagonal = 2 * math.atan(math.hypot(320, 180) / FRONT_INFO.K[0])
    assert math.degrees(diagonal) == pytest.approx(92.0)
    assert field_of_view(FRONT_INFO) == pytest.approx(2 * math.atan(180 / FRONT_INFO.K[0]))


def test_the_nearest_sightings_in_time_are_taken_unless_too_old():
    kept = [sightings(t_ns) for t_ns in (0, 100_000_000, 200_000_000)]
    assert sightings_of(100_000_000, kept) is kept[1]
    assert sightings_of(170_000_000, kept) is kept[2]
    assert sightings_of(AGE_MAX_NS, [sightings(0)]) is not None
    assert sightings_of(AGE_MAX_NS + 1, [sightings(0)]) is None
    assert sightings_of(0, [sightings(AGE_MAX_NS + 1)]) is None  # a replay has jumped back
    assert sightings_of(0, []) is None


Image = pytest.importorskip("PIL.Image", reason="Pillow comes with viser; pip install '.[console]'")


def encoded(width: int = 40, height: int = 30, kind: str = "JPEG", **options: Any) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (width, height), (20, 90, 160)).save(out, kind, **options)
    return out.getvalue()


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"quality": 10}, {"comment": "x" * 3000}])
def test_the_size_of_a_jpeg_is_read(options: dict[str, Any]):
    whole = encoded(641, 363, **options)
    filled = whole[:2] + b"\xff\xff" + whole[2:]  # fill bytes before a marker are skipped
    assert frame_of(whole)[1:] == frame_of(filled)[1:] == (641, 363)


@given(st.binary(max_size=200))
def test_any_bytes_yield_a_size_or_are_refused(middle: bytes):
    with suppress(PictureError):
        assert all(0 < side < 2**16 for side in frame_of(b"\xff\xd8" + middle + b"\xff\xd9")[1:])


@given(at=st.integers(0, 600), byte=st.integers(0, 255))
def test_a_corrupt_byte_does_no_harm(at: int, byte: int):
    data = bytearray(encoded())
    data[at % len(data)] = byte
    with suppress(PictureError):
        check_picture(bytes(data), 40, 30)


NO_JPEG = (
    b"", b"\xff\xd8", b"\xff\xd8\xff\xd9", b"no picture", encoded(kind="PNG"), encoded()[:-40],
    encoded()[:30] + b"\xff\xd9",
)  # fmt: skip


@pytest.mark.parametrize(
    ("data", "width", "height", "terms"),
    [
        *((data, 40, 30, ()) for data in NO_JPEG),
        (encoded(), 30, 40, ("40 × 30", "30 × 40")),
        (encoded(4000, 4000), 4000, 4000, ("4000 × 4000", "2304000")),  # it would fill a browser's memory
        (encoded()[:-2] + bytes(PICTURE_BYTES_MAX) + encoded()[-2:], 40, 30, (str(PICTURE_BYTES_MAX),)),
    ],
)
def test_invalid_mismatched_and_oversized_jpegs_are_refused(
    data: bytes, width: int, height: int, terms: tuple[str, ...]
):
    check_picture(encoded(), 40, 30)
    with refused(PictureError, *terms):
        check_picture(data, width, height)
