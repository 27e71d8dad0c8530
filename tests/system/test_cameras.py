"""Cameras and detectors of a run: sightings agree with the truth, which neither they nor their failures change."""

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from federation import Federation, Record
from refused import has_terms
from wire import Client

from zsim.contract.flight_messages import CameraInfo
from zsim.errors import ScenarioError
from zsim.math.frames import rotation_matrix
from zsim.math.rotation import pose_between
from zsim.scenario import scenario_file
from zsim.sensors.camera import FrontCamera, Hats
from zsim.sensors.camera_model import camera_pose
from zsim_agents.cameras.detector import decoded
from zsim_analysis.in_process import InProcessFlight

PAIR = """
name: pair
seed: 3
duration_s: 9
sensors: {preset: paper, front_camera: {rate_hz: 10}}
environment: {wind: {gust_m_s: 0.3}}
drones:
  - {name: drone1, position_m: [2, 0, 0], yaw_deg: 180}
  - {name: drone2, position_m: [-2, 0, 0], yaw_deg: 90}
clusters:
  - {name: main, drones: [drone1, drone2], plan: {takeoff_s: 0.5}}
"""
PICTURES, INFO, SEEN = "drone/drone1/camera/front", "drone/drone1/camera/front/info", "drone/drone1/sightings"
HEALTH = "process/detector.main/health"
AIRBORNE_NS = 4_000_000_000
GATE_S = 0.02
SIGMAS = 5.0
SEEN_DEAD = ("death", "superseded")  # the second if it is restarted before its death is noticed
FOREVER = ("--duration", "600", "--rate", "1")
LEAST = 12  # number of sightings to compare with the truth
GATING = ("--set", "processes.gating=[camera]")
GATED_S, RATE_HZ = 6, 10
NAMED = ("silent", "death")  # the second if its blocked link is closed first
GARBAGE = (b"", b"\xff\xd8\xff\xd9", bytes(range(256)))


class Flown:
    """The record of a run, and the hash of the truth of the same flight without cameras."""

    def __init__(self, record: Record, without: str) -> None:
        self.record, self.without = record, without


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Any:
    """A flight whose camera process is killed in the air, and a stranger that publishes garbage on the camera's key."""
    with Federation(tmp_path_factory.mktemp("cameras")) as federation:
        run = federation.run(PAIR, "--cameras", "--detect", *FOREVER)
        client = federation.client()
        pictures, seen, events, health = (client.subscribe(key) for key in (PICTURES, SEEN, "world/event", HEALTH))
        for _ in range(LEAST):
            seen.until(lambda m: m["t_ns"] >= AIRBORNE_NS and m["seen"])
        publish_garbage(client)
        health.until(lambda m: m["refused"] >= 1 or publish_garbage(client))  # a detector that lags skips pictures
        infos = client.subscribe(INFO)
        federation.kill("camera")
        infos.until(lambda m: m["source"] == "camera.main")
        died_ns = events.until(lambda m: m["kind"] in SEEN_DEAD and m["subject"] == "camera.main").message["t_ns"]
        pictures.until(lambda m: m["source"] == "camera.main" and m["t_ns"] > died_ns + 300_000_000)
        assert client.request("world/control", "stop")["ok"]
        run.ends(with_code=0)
        record = federation.record()
        yield Flown(record, sha256_alone(tmp_path_factory.mktemp("alone"), record.end()["last_ns"] / 1e9))


def sha256_alone(folder: Path, duration_s: float) -> str:
    """Return the hash of the truth of the same flight without cameras."""
    with Federation(folder) as federation:
        federation.run(PAIR, "--in-process", "--duration", str(duration_s)).ends(with_code=0)
        return federation.record().sha256()


def publish_garbage(client: Client) -> None:
    shape = {"width": 640, "height": 360, "format": "jpeg"}
    for data in GARBAGE:
        client.put(PICTURES, t_ns=0, seq=0, t_sample_ns=0, source="stranger", data=data, **shape)


def test_neither_cameras_nor_their_death_change_a_bit_of_the_truth(flown: Flown) -> None:
    assert flown.record.sha256() == flown.without
    assert flown.record.recomputed_sha256(["drone1", "drone2"]) == flown.without


def test_pictures_are_exposed_on_schedule_and_published_in_time(flown: Flown) -> None:
    pictures = [m for m in flown.record.all(PICTURES) if m["source"] == "camera.main"]
    assert len(pictures) > LEAST
    for each in pictures:
        assert each["t_sample_ns"] % 100_000_000 == 0
        assert 0 <= each["t_ns"] - each["t_sample_ns"] <= 300_000_000
        assert decoded(each["data"], 640, 360).std() > 10


def test_the_camera_info_describes_the_camera(flown: Flown) -> None:
    infos = flown.record.all(INFO)
    assert len(infos) >= 2  # published again by the restarted camera
    assert set(infos[0]) == set(CameraInfo.__struct_fields__)
    assert infos[0]["rate_hz"] == 10
    assert infos[0]["K"][0] == pytest.approx(354.6, abs=0.1)
    assert infos[0]["gate_ns"] == 20_000_000


def test_sightings_agree_with_the_truth(flown: Flown) -> None:
    truths = {drone: flown.record.all(f"drone/{drone}/truth") for drone in ("drone1", "drone2")}
    checked = 0
    for message in flown.record.all(SEEN):
        for seen in message["seen"]:
            direction, distance = expected(truths, message["t_sample_ns"] / 1e9)
            off = np.linalg.norm(np.array(seen["direction_B"]) - direction)
            assert off < SIGMAS * seen["sigma_direction_rad"]
            assert abs(seen["range_m"] - distance) < SIGMAS * seen["sigma_range_m"]
            assert (message["camera"], message["source"]) == ("front", "detector.main")
            checked += 1
    assert checked >= LEAST


def expected(truths: dict[str, list[dict[str, Any]]], t_s: float) -> tuple[np.ndarray, float]:
    """Return the direction (in B) and distance of drone2's hat from drone1's camera at an instant."""
    (p, q), (p2, q2) = (pose(truths[drone], t_s) for drone in ("drone1", "drone2"))
    hat_B = rotation_matrix(q).T @ (p2 + rotation_matrix(q2) @ np.array(Hats().position_m) - p)
    ray = hat_B - camera_pose(FrontCamera()).p_BK
    return ray / np.linalg.norm(ray), float(np.linalg.norm(ray))


def pose(truths: list[dict[str, Any]], t_s: float) -> tuple[np.ndarray, np.ndarray]:
    k = min(int(t_s / GATE_S + 1e-9), len(truths) - 2)
    a, b = truths[k], truths[k + 1]
    (t0, p0, v0, q0), (t1, p1, v1, q1) = (
        (m["t_ns"] / 1e9, m["position_m"], m["velocity_m_s"], m["orientation_wxyz"]) for m in (a, b)
    )
    ends = (t0, tuple(p0), tuple(v0), tuple(q0)), (t1, tuple(p1), tuple(v1), tuple(q1))
    p, _, q = pose_between(t_s, *ends[0], *ends[1])
    return np.array(p), np.array(q)


def test_pictures_of_a_stranger_are_refused_and_counted(flown: Flown) -> None:
    assert flown.record.all(HEALTH)[-1]["refused"] >= 1
    assert {event["subject"] for event in flown.record.events(*SEEN_DEAD)} == {"camera.main"}


@pytest.mark.slow
def test_a_gating_camera_omits_no_picture(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> None:
    with Federation(tmp_path_factory.mktemp("gating")) as federation:
        federation.run(PAIR, "--cameras", "--duration", str(GATED_S), *GATING).ends(with_code=0)
        record = federation.record()
        sha256 = record.sha256()
        stamps = [message["t_sample_ns"] for message in record.all(PICTURES)]
    of_all = [round(n * 1e9 / RATE_HZ) for n in range(GATED_S * RATE_HZ + 1)]
    assert stamps in (of_all, of_all[:-1])  # the last one may arrive after the run is over
    assert sha256 == sha256_alone(tmp_path_factory.mktemp("without"), GATED_S)


@pytest.mark.slow
@pytest.mark.soak
def test_pictures_resume_after_a_gating_camera_is_killed(
    tmp_path_factory: pytest.TempPathFactory, compiled: None
) -> None:
    """The launcher starts the camera without --cameras, because the scenario gates on it."""
    with Federation(tmp_path_factory.mktemp("killed")) as federation:
        run = federation.run(PAIR, "--duration", "30", "--rate", "4", *GATING)
        client = federation.client()
        pictures, events = client.subscribe(PICTURES), client.subscribe("world/event")
        pictures.until(lambda m: m["t_ns"] > 2_000_000_000)
        federation.kill("camera")
        died_ns = events.until(lambda m: m["kind"] in SEEN_DEAD and m["subject"] == "camera.main").message["t_ns"]
        pictures.until(lambda m: m["t_ns"] > died_ns + 2_000_000_000)
        assert client.request("world/control", "stop")["ok"]
        run.ends(with_code=0)


def test_an_in_process_run_refuses_to_gate_on_cameras(tmp_path_factory: pytest.TempPathFactory) -> None:
    place = tmp_path_factory.mktemp("one") / "pair.yaml"
    place.write_text(PAIR)
    with pytest.raises(ScenarioError, match=r"processes\.gating"):
        InProcessFlight(scenario_file.load(place, ["processes.gating=[camera]"]))


amiss = pytest.mark.soak  # cameras run at low priority: on a loaded machine they stall by themselves


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Any:
    """A flight with a second detector for drone1, whose camera process is stopped for a while."""
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
def test_disturbed_cameras_change_no_bit_of_the_truth(disturbed: Flown) -> None:
    assert disturbed.record.sha256() == disturbed.without


@amiss
def test_two_detectors_of_one_drone_are_reported(disturbed: Flown) -> None:
    doubled = disturbed.record.events("doubled")
    assert doubled
    for each in doubled:
        assert {each["subject"], each["data"]["other"]} == {"detector.second", "detector.main"}
        assert has_terms(each["text"], "detector.drone1")


@amiss
def test_two_detectors_publish_the_same_sightings_under_their_names(disturbed: Flown) -> None:
    of_both = {name: {} for name in ("detector.main", "detector.second")}
    for message in disturbed.record.all(SEEN):
        of_both[message["source"]][message["t_sample_ns"]] = message["seen"]
    both = of_both["detector.main"].keys() & of_both["detector.second"].keys()
    assert both
    assert all(of_both["detector.main"][t_ns] == of_both["detector.second"][t_ns] for t_ns in both)


@amiss
def test_a_stalled_camera_is_reported_and_omits_overdue_pictures(disturbed: Flown) -> None:
    assert "camera.main" in {event["subject"] for event in disturbed.record.events(*NAMED)}
    assert disturbed.record.events("drop", "overdue") == []
    late = [m["t_ns"] - m["t_sample_ns"] for m in disturbed.record.all(PICTURES)]
    assert max(late) <= 300_000_000


ONE_SEES = PAIR.replace(", front_camera: {rate_hz: 10}", "").replace(
    "{name: drone1,", "{name: drone1, sensors: {front_camera: {}},"
)

# name: (command, terms that its output must contain)
UNKNOWN = {
    "a camera of nobody": (("camera", "ghost"), ("'ghost'", "drone1")),
    "a camera of one without": (("camera", "drone2"), ("'drone2'", "drone1")),
    "a detector of nobody": (("detect", "ghost"), ("'ghost'", "drone1", "drone2")),
}


def test_an_impossible_camera_or_detector_is_refused(federation: Federation) -> None:
    federation.world(ONE_SEES, *FOREVER, "--expect", "nobody.yet")
    for name, (command, terms) in UNKNOWN.items():
        role = federation.role(*command)
        role.ends(with_code=2)
        assert has_terms(role.text(), *terms), name
