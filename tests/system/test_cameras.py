"""A run with cameras and detectors: what they see agrees with the truth, and no failure of theirs changes it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from federation import Federation, Record
from wire import Client

from zsim.contract.flight_messages import CameraInfo
from zsim.math.frames import rotation_matrix
from zsim.math.rotation import pose_between
from zsim.sensors.camera import FrontCamera, Hats
from zsim.sensors.camera_model import camera_pose
from zsim_agents.cameras.detector import decoded

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
SEEN_DEAD = ("death", "superseded")  # the second where it is back before its death is noticed
FOREVER = ("--duration", "600", "--rate", "1")
LEAST = 12  # sightings that are compared with the truth
GARBAGE = (b"", b"\xff\xd8\xff\xd9", bytes(range(256)))


class Flown:
    """The run: its record, and the hash of the truth of the same flight without cameras."""

    def __init__(self, record: Record, without: str) -> None:
        self.record, self.without = record, without


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Any:
    """A flight whose camera is killed in the air, and on whose camera key a stranger publishes garbage."""
    with Federation(tmp_path_factory.mktemp("cameras")) as federation:
        run = federation.run(PAIR, "--cameras", "--detect", *FOREVER)
        client = federation.client()
        pictures, seen, events, health = (client.subscribe(key) for key in (PICTURES, SEEN, "world/event", HEALTH))
        for _ in range(LEAST):
            seen.until(lambda m: m["t_ns"] >= AIRBORNE_NS and m["seen"])
        publish_garbage(client)
        health.until(lambda m: m["refused"] >= 1 or publish_garbage(client))  # a detector that lags skips pictures
        federation.kill("camera")
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


def test_no_bit_of_the_truth_changes_with_cameras_nor_with_their_death(flown: Flown) -> None:
    assert flown.record.sha256() == flown.without
    assert flown.record.recomputed_sha256(["drone1", "drone2"]) == flown.without


def test_pictures_are_of_the_exposures_that_are_due(flown: Flown) -> None:
    pictures = [m for m in flown.record.all(PICTURES) if m["source"] == "camera.main"]
    assert len(pictures) > LEAST
    for each in pictures:
        assert each["t_sample_ns"] % 100_000_000 == 0
        assert 0 <= each["t_ns"] - each["t_sample_ns"] <= 300_000_000
        assert decoded(each["data"], 640, 360).std() > 10


def test_the_info_says_what_the_pixels_mean(flown: Flown) -> None:
    infos = flown.record.all(INFO)
    assert len(infos) >= 2  # again by the one that was started in the place of the killed one
    assert set(infos[0]) == set(CameraInfo.__struct_fields__)
    assert infos[0]["rate_hz"] == 10
    assert infos[0]["K"][0] == pytest.approx(354.6, abs=0.1)
    assert infos[0]["gate_ns"] == 20_000_000


def test_what_is_seen_is_where_the_truth_has_it(flown: Flown) -> None:
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
    """Return direction in B and distance of drone2's hat from drone1's camera at an instant."""
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
