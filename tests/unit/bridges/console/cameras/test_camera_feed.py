"""The pictures of a run: subscribed to while a page asks, checked, matched with what was seen, and sent to pages."""

import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import synthetic_camera
from refused import has_terms

from zsim.contract import keys, messages
from zsim.errors import SessionError
from zsim_bridges.console.camera_feed import ASKED_S, PICTURE_BYTES_MAX, SIGHTINGS_KEPT, CameraFeed
from zsim_bridges.console.page_sockets import PageBatches

FRONT, BOTTOM = "drone1/front", "drone1/bottom"
PAGE = "a page"
JPEG = {name: synthetic_camera.picture(name, 1) for name in ("front", "bottom")}


class Link:
    """A session on which only the test speaks."""

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
    """A feed, and what is said to it."""

    def __init__(self) -> None:
        self.link = Link()
        self.health = SimpleNamespace(received=0, refused=0)
        self.wall_s = 100.0
        link: Any = self.link
        observer: Any = SimpleNamespace(health=self.health)
        self.feed = CameraFeed(link, observer, ["drone1", "drone2"], 0.14, lambda: self.wall_s)

    def say(self, key: str, message: Any) -> None:
        """Publish a message, or bytes, to who subscribes."""
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
        self.feed.ask(PAGE, cameras)
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
    """Return header and pictures of the next message to a page."""
    data = made.next(feed, want)
    assert data is not None
    end = 4 + int.from_bytes(data[:4], "big")
    return json.loads(data[4:end]), data[end:]


# What is subscribed to


def test_without_cameras_nothing_is_subscribed_to_and_nothing_is_shown(run: Run):
    run.watch(FRONT)
    assert list(run.link.subscribed) == [keys.camera_info("*", "*")]
    assert run.feed.cameras() == ()
    assert PageBatches().next(run.feed, ()) is None


def test_without_a_page_no_picture_is_subscribed_to(run: Run):
    run.say_infos()
    run.feed.update()
    assert [name for name, _ in run.feed.cameras()] == [FRONT, BOTTOM]
    assert run.link.pictures() == set()


def test_what_a_page_looks_at_is_subscribed_to_and_no_more(run: Run):
    run.say_infos()
    run.say_infos("drone2")
    run.watch(FRONT)
    assert run.link.pictures() == {"drone/drone1/camera/front"}
    run.watch("drone2/bottom")
    assert run.link.pictures() == {"drone/drone2/camera/bottom"}
    run.feed.release(PAGE)
    run.feed.update()
    assert list(run.link.subscribed) == [keys.camera_info("*", "*")]


def test_two_pages_keep_each_others_pictures(watched: Run):
    watched.feed.ask("another", [FRONT])
    watched.feed.release(PAGE)
    watched.feed.update()
    assert watched.link.pictures() == {"drone/drone1/camera/front"}


def test_a_page_that_sleeps_costs_nothing(watched: Run):
    watched.wall_s += ASKED_S - 0.1
    watched.feed.update()
    assert len(watched.link.pictures()) == 2
    watched.wall_s += 0.1
    watched.feed.update()
    assert watched.link.pictures() == set()


def test_a_run_that_is_over_leaves_no_subscription_to_pictures(watched: Run):
    watched.feed.close()
    assert watched.link.pictures() == set()


def test_cameras_of_before_are_asked_for_and_those_of_strangers_left_out():
    run = Run()
    for drone in ("drone1", "stranger"):
        payload = messages.encode(synthetic_camera.info_of("front"))
        run.link.kept.append(SimpleNamespace(key=keys.camera_info(drone, "front"), payload=payload))
    run.feed.open()
    assert [name for name, _ in run.feed.cameras()] == [FRONT]


def test_a_certificate_that_may_not_ask_does_no_harm():
    run = Run()
    run.link.refusal = SessionError("may not ask")
    run.feed.open()
    run.say_infos()
    assert len(run.feed.cameras()) == 2


@pytest.mark.parametrize("payload", [b"", b"\x00", {"orientation_wxyz": (0.0, 0.0, 0.0, 0.0)}])
def test_a_camera_that_cannot_be_used_is_counted(run: Run, payload: Any):
    info = synthetic_camera.info_of("front")
    message = msgspec.structs.replace(info, **payload) if isinstance(payload, dict) else payload
    run.say(keys.camera_info("drone1", "front"), message)
    assert run.feed.cameras() == ()
    assert run.health.refused == 1


# Pictures


def test_the_newest_picture_is_shown_as_it_came(watched: Run):
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
def test_a_bad_picture_is_left_out_and_counted_and_nothing_else_is_touched(watched: Run, changes: dict[str, Any]):
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


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80"])
def test_what_is_no_message_on_a_cameras_key_is_counted(watched: Run, payload: bytes):
    watched.say(keys.camera("drone1", "front"), payload)
    assert watched.feed.picture(FRONT) is None
    assert watched.health.refused == 1


def test_a_picture_too_large_is_not_even_kept(watched: Run):
    watched.say(keys.camera("drone1", "front"), bytes(PICTURE_BYTES_MAX + 2000))
    assert watched.feed.state()[0]["refused"] == 1


# Sightings


def detected(run: Run, t_ns: int, key: str = keys.detections("drone1")) -> None:
    run.say(key, synthetic_camera.sightings_message(1, t_ns))


def test_what_was_seen_at_the_pictures_time_is_drawn_on_it(watched: Run):
    watched.say_picture(t_ns=1_000_000_000)
    assert watched.feed.marks(FRONT) == ()
    assert watched.feed.picture(FRONT) is not None
    detected(watched, 1_000_000_000)
    (mark,) = watched.feed.marks(FRONT)
    assert (mark.u, mark.v) == pytest.approx(synthetic_camera.projected("front", synthetic_camera.HAT_B), abs=0.06)
    assert mark.text == "6.1 ± 0.2 m"
    assert watched.feed.marks(BOTTOM) == ()


def test_what_a_detector_found_goes_before_what_the_world_saw(watched: Run):
    watched.say_picture(t_ns=0)
    assert watched.feed.picture(FRONT) is not None
    world = msgspec.structs.replace(synthetic_camera.sightings_message(1, 0), seen=())
    detected(watched, 0, keys.sensor("drone1", keys.SIGHTINGS))
    assert len(watched.feed.marks(FRONT)) == 1
    watched.say(keys.detections("drone1"), world)
    assert watched.feed.marks(FRONT) == ()


def test_few_sightings_are_kept(watched: Run):
    watched.say_picture(t_ns=0)
    assert watched.feed.picture(FRONT) is not None
    for number in range(SIGHTINGS_KEPT + 1):
        detected(watched, number * 1_000_000_000)
    assert watched.feed.marks(FRONT) == ()  # that of the picture's time is gone


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80"])
def test_sightings_that_are_none_are_counted(watched: Run, payload: bytes):
    watched.say(keys.detections("drone1"), payload)
    assert watched.health.refused == 1


# What a page is sent


def test_a_page_is_told_of_cameras_and_sent_what_it_asks_for(watched: Run):
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


def test_only_what_has_changed_is_sent(watched: Run):
    made = PageBatches()
    watched.say_picture()
    watched.say_picture("bottom")
    batch(made, watched.feed, FRONT, BOTTOM)
    assert made.next(watched.feed, (FRONT, BOTTOM)) is None
    watched.say_picture()
    header, data = batch(made, watched.feed, FRONT, BOTTOM)
    assert [each["camera"] for each in header["pictures"]] == [FRONT]
    assert data == JPEG["front"]


def test_a_detection_that_comes_after_its_picture_is_sent_without_it(watched: Run):
    made = PageBatches()
    watched.say_picture(t_ns=0)
    batch(made, watched.feed, FRONT)
    detected(watched, 0)
    header, data = batch(made, watched.feed, FRONT)
    assert [(each["size"], len(each["marks"])) for each in header["pictures"]] == [(0, 1)]
    assert data == b""


def test_a_page_learns_that_a_run_is_over(watched: Run):
    made = PageBatches()
    batch(made, watched.feed)
    header, _ = batch(made, Run().feed)
    assert header == {"cameras": [], "pictures": []}
