"""The process of a detector: what arrives on a camera's keys that is none of its pictures is counted, and held nowhere."""

from collections.abc import Sequence
from typing import Any

import pytest
from fake_link import FakeLink
from msgspec.structs import replace
from pictures import HATS
from refused import has_terms
from synthetic_pictures import NO_JPEG, WIDTH_PX, image, info, jpeg

from zsim.contract import keys
from zsim.contract.flight_messages import Sightings
from zsim.contract.messages import Info, Origin
from zsim.runtime.participant import Participant
from zsim_agents.cameras import detector_process
from zsim_agents.cameras.detector import PIXELS_MAX
from zsim_agents.cameras.detector_process import REPORTS_MAX, DetectorProcess

INFO = Info(0, 0, 1, "r", "zsim", "lockstep", 0.0, 1, 1, 1, 1, Origin(0.0, 0.0, 0.0), (), (), "", "", "", "")
FRONT, FRONT_INFO = keys.camera("d1", "front"), keys.camera_info("d1", "front")
SIDE, SIDE_INFO = keys.camera("d1", "side"), keys.camera_info("d1", "side")
ABSURD_PX = 16_384  # as many as the contract lets a side have


class Detecting:
    """A detector of drone d1, or of others, whatever it says, and what it publishes."""

    def __init__(self, drones: Sequence[str] = ("d1",)) -> None:
        self.link, self.said = FakeLink(), []
        link: Any = self.link
        self.presence = Participant(link, INFO, "detector.d1")
        self._process = DetectorProcess(link, self.presence, self.said.append, drones, HATS.diameter_m)
        self._process.begin()

    def take(self, *arrived: tuple[str, Any]) -> None:
        """Let messages arrive, and the process take one turn."""
        for key, message in arrived:
            self.link.deliver(key, message)
        self._process.turn()

    def sightings(self) -> list[Sightings]:
        return self.link.published_on(keys.detections("d1"))

    def counted(self) -> tuple[int, int, int]:
        """Return how many it took, refused and left out."""
        health = self.presence.health
        return health.received, health.refused, health.dropped


def test_a_picture_is_looked_at_once_its_pixels_mean_something() -> None:
    detecting = Detecting()
    detecting.take((FRONT, image(1)))
    assert (detecting.sightings(), detecting.counted()) == ([], (0, 0, 1))
    detecting.take((FRONT_INFO, info()), (FRONT, image(10_000_000)))
    (seen,) = detecting.sightings()
    assert (seen.t_sample_ns, seen.source, seen.camera, seen.seen) == (6_000_000, "detector.d1", "front", ())
    assert detecting.counted() == (1, 0, 1)


def of_an_absurd_size() -> bytes:
    """Return a small JPEG whose header claims gigapixels."""
    data = bytearray(jpeg())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = b"\xff\xff\xff\xff"
    return bytes(data)


NO_PICTURES = {
    "no jpeg": NO_JPEG,
    "nothing": b"",
    "cut": jpeg()[:-200],
    "of another size": jpeg(width=2 * WIDTH_PX),
    "of an absurd size": of_an_absurd_size(),
}


@pytest.mark.parametrize("name", NO_PICTURES)
def test_what_is_no_picture_of_the_camera_is_counted_and_the_next_one_is_looked_at(name: str) -> None:
    detecting = Detecting()
    detecting.take((FRONT_INFO, info()), (FRONT, image(0, data=NO_PICTURES[name])))
    detecting.take((FRONT, image(10_000_000)))
    assert detecting.counted() == (1, 1, 0)
    assert len(detecting.sightings()) == 1
    assert has_terms(detecting.said[0], "detector.d1", FRONT)


def test_pictures_that_are_none_are_told_of_a_few_times_only() -> None:
    detecting = Detecting()
    for _ in range(50):
        detecting.take((FRONT, image(0, data=NO_JPEG)))
    assert (detecting.counted()[1], len(detecting.said)) == (50, REPORTS_MAX)


@pytest.mark.parametrize(
    ("fields", "terms"),
    [
        ({"width": ABSURD_PX, "height": ABSURD_PX}, (str(ABSURD_PX), str(PIXELS_MAX))),
        ({"K": (0.0,) * 9}, ("0", "> 0")),
        ({"width": 10**9}, ("width", str(10**9))),
    ],
)
def test_what_its_pixels_cannot_mean_is_refused_before_memory_is_taken(
    monkeypatch: pytest.MonkeyPatch, fields: dict[str, Any], terms: tuple[str, ...]
) -> None:
    monkeypatch.setattr(detector_process, "HatDetector", lambda *_: pytest.fail("was made"))
    detecting = Detecting()
    detecting.take((FRONT_INFO, replace(info(), **fields)))
    assert detecting.counted() == (0, 1, 0)
    assert has_terms(detecting.said[0], FRONT_INFO, *terms)
    assert detecting.said[0].count(FRONT_INFO) == 1


def test_of_many_pictures_only_the_newest_is_held() -> None:
    detecting = Detecting()
    detecting.take((FRONT_INFO, info()), *((FRONT, image(number * 1_000_000)) for number in range(100)))
    assert detecting.counted() == (1, 0, 99)
    assert [seen.t_ns for seen in detecting.sightings()] == [99_000_000]


def test_of_too_many_pictures_as_many_are_looked_at_of_each_camera() -> None:
    """Whenever it has looked at one there are new ones of all."""
    drones = ["d1", "d2", "d3"]
    detecting = Detecting(drones)

    def all_expose(key: str = "", _: object = None) -> None:
        for drone in drones if not key or key.endswith("/sightings") else ():
            detecting.link.deliver(keys.camera(drone, "front"), image(0))

    detecting.take(*((keys.camera_info(drone, "front"), info()) for drone in drones))
    all_expose()
    detecting.link.on_publish = all_expose
    for _ in range(4):
        detecting.take()
    assert [len(detecting.link.published_on(keys.detections(drone))) for drone in drones] == [4, 4, 4]


def test_a_camera_that_no_drone_has_is_not_looked_at() -> None:
    detecting = Detecting()
    detecting.take((SIDE_INFO, info()), (SIDE, image(0)), (FRONT_INFO, info()), (FRONT, image(0)))
    assert [seen.camera for seen in detecting.sightings()] == ["front"]
    assert detecting.counted() == (1, 0, 0)
