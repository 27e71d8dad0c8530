"""Two detectors of one drone, a camera that stands still, one that nobody has: named, and the flight is untouched."""

import signal
from typing import Any

import pytest
from federation import Federation
from refused import has_terms
from test_cameras import FOREVER, PAIR, PICTURES, SEEN, Flown, sha256_alone

NAMED = ("silent", "death")  # the second where its link, which takes nothing, is closed before


amiss = pytest.mark.soak  # cameras are nice: on a loaded machine they stand still of themselves


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Any:
    """A flight with a second detector of drone1, whose camera is stopped for a while and goes on."""
    with Federation(tmp_path_factory.mktemp("amiss")) as federation:
        run = federation.run(PAIR, "--cameras", "--detect", *FOREVER)
        client = federation.client()
        pictures, seen, events = (client.subscribe(key) for key in (PICTURES, SEEN, "world/event"))
        seen.until(lambda m: m["source"] == "detector.main")
        federation.role("detect", "drone1", "--name", "detector.second")
        seen.until(lambda m: m["source"] == "detector.second")
        events.until(lambda m: m["kind"] == "doubled")
        federation.kill("camera", signal.SIGSTOP)
        named = events.until(lambda m: m["kind"] in NAMED and m["subject"] == "camera.main")
        federation.kill("camera", signal.SIGCONT)
        pictures.until(lambda m: m["t_sample_ns"] > named.message["t_ns"])
        assert client.request("world/control", "stop")["ok"]
        run.ends(with_code=0)
        record = federation.record()
        yield Flown(record, sha256_alone(tmp_path_factory.mktemp("alone"), record.end()["last_ns"] / 1e9))


@amiss
def test_no_bit_of_the_truth_changes(flown: Flown) -> None:
    assert flown.record.sha256() == flown.without


@amiss
def test_two_detectors_of_a_drone_are_named(flown: Flown) -> None:
    doubled = flown.record.events("doubled")
    assert doubled
    for each in doubled:
        assert {each["subject"], each["data"]["other"]} == {"detector.second", "detector.main"}
        assert has_terms(each["text"], "detector.drone1")


@amiss
def test_each_of_two_detectors_says_whose_sightings_it_publishes(flown: Flown) -> None:
    of_both = {name: {} for name in ("detector.main", "detector.second")}
    for message in flown.record.all(SEEN):
        of_both[message["source"]][message["t_sample_ns"]] = message["seen"]
    both = of_both["detector.main"].keys() & of_both["detector.second"].keys()
    assert both
    assert all(of_both["detector.main"][t_ns] == of_both["detector.second"][t_ns] for t_ns in both)


@amiss
def test_a_camera_that_stands_still_is_named_and_leaves_out_what_is_too_old(flown: Flown) -> None:
    assert "camera.main" in {event["subject"] for event in flown.record.events(*NAMED)}
    assert flown.record.events("drop", "overdue") == []
    late = [m["t_ns"] - m["t_sample_ns"] for m in flown.record.all(PICTURES)]
    assert max(late) <= 300_000_000


ONE_SEES = PAIR.replace(", front_camera: {rate_hz: 10}", "").replace(
    "{name: drone1,", "{name: drone1, sensors: {front_camera: {}},"
)

# name: (command, what its last line must show)
UNKNOWN = {
    "a camera of nobody": (("camera", "ghost"), ("'ghost'", "drone1")),
    "a camera of one without": (("camera", "drone2"), ("'drone2'", "drone1")),
    "a detector of nobody": (("detect", "ghost"), ("'ghost'", "drone1", "drone2")),
}


def test_a_camera_that_is_none_is_a_line(federation: Federation) -> None:
    federation.world(ONE_SEES, *FOREVER, "--expect", "nobody.yet")
    for name, (command, terms) in UNKNOWN.items():
        role = federation.role(*command)
        role.ends(with_code=2)
        assert has_terms(role.text(), *terms), name
