"""Scans of a fleet against closed forms: directions, errors, other drones, sample times and losses."""

import math
from typing import Any

import numpy as np
import pytest

from zsim.contract import messages
from zsim.contract.messages import Depth, Lidar, Range
from zsim.contract.run_messages import Fault
from zsim.contract.snapshot import pack, restore, saved_state, unpack
from zsim.math.frames import rotation_matrix
from zsim.scenario.scenario_file import resolve
from zsim.sensors.scanner import SCANNERS
from zsim_world.fleet.fleet import Fleet
from zsim_world.fleet.publication import GatePublication
from zsim_world.physics.fleet_arrays import VEHICLE

WALL = {"name": "wall", "shape": "box", "position_m": [6, 0, 0], "size_m": [2, 40, 20]}  # its face is at x = 5
EXACT = {"noise_m": 0, "noise_share": 0, "noise_1_m": 0, "bias_m": 0}


def fleet(*places: tuple[float, ...], obstacles: Any = (WALL,), **sensors: Any) -> Fleet:
    """Return drones that stand at, or fall from, these places; scanners are exact unless configured otherwise."""
    scanners = {name: EXACT | each if name in SCANNERS else each for name, each in sensors.items()}
    document: dict[str, Any] = {
        "name": "scans",
        "duration_s": 10,
        "environment": {"obstacles": [*obstacles]},
        "sensors": scanners,
        "drones": [
            {"name": f"d{i}", "position_m": place[:3], "yaw_deg": sum(place[3:])} for i, place in enumerate(places)
        ],
    }
    return Fleet(resolve(document))


def taken(fleet: Fleet, kind: Any, drone: int = 0) -> Any:
    """Return the last gate's message of a kind, as readers receive it."""
    (scan,) = (
        each for each in fleet.observations.values() if each.drone == drone and isinstance(each.message(0), kind)
    )
    key = f"drone/d{drone}/sensor/{scan.sensor}"
    return messages.decode(key, messages.encode(scan.message(0)))


def test_beams_of_a_turned_drone_find_the_wall():
    """The drone faces north, so the wall in the east is to its right; the upward beam meets nothing."""
    made = fleet((0, 0, 0, 90.0), range={"max_m": 8, "mount": {"position_m": [0, 0, 0.3]}})
    message = taken(made, Range)
    assert message.beams == ("back", "front", "left", "right", "up")
    np.testing.assert_allclose(message.ranges_m, [0, 0, 0, 5.0, 0], atol=1e-6)


def test_a_beam_starts_at_its_mount_and_a_cone_covers_its_surroundings():
    """The post has a radius of 1 cm and stands 4 m ahead, 0.2 m beside the axis."""
    post = {"name": "post", "shape": "cylinder", "position_m": [4, 0.2, 0], "radius_m": 0.01, "height_m": 3}
    ahead = {"beams": {"ahead": {"position_m": [1, 0, 0.5]}}, "max_m": 8}
    (far,) = taken(fleet((0, 0, 0), obstacles=[post, WALL], range=ahead), Range).ranges_m
    assert far == pytest.approx(4.0, abs=1e-6)
    cone = ahead | {"cone_deg": 2 * math.degrees(math.atan2(0.2, 3.0))}
    (near,) = taken(fleet((0, 0, 0), obstacles=[post, WALL], range=cone), Range).ranges_m
    assert near == pytest.approx(math.hypot(3.0, 0.2) - 0.01, abs=1e-4)


def test_a_lidar_shows_a_flat_wall_in_the_directions_of_its_message():
    settings = {"channels": 3, "columns": 90, "elevation_deg": [-10, 10], "azimuth_deg": [-45, 45], "max_m": 30}
    made = fleet((0, 0, 1), lidar=settings)
    message, truth = taken(made, Lidar), made.truth()
    points = message.ranges()[..., None] * message.directions()
    points_W = truth.position_m[0] + points @ rotation_matrix(truth.orientation_wxyz[0]).T
    np.testing.assert_allclose(points_W[message.directions()[..., 2] > -0.1][:, 0], 5.0, atol=1e-5)
    assert message.ranges().shape == (3, 90)
    assert message.azimuth_rad == pytest.approx((-math.pi / 4, math.radians(1.0)))


def test_a_depth_image_of_a_wall_is_flat_and_has_the_camera_s_geometry():
    camera = {"mount": {"position_m": [0, 0, 3]}}
    made = fleet((0, 0, 0), front_camera=camera, depth={"columns": 16, "rows": 9, "max_m": 8})
    message = taken(made, Depth)
    np.testing.assert_allclose(message.depths()[:5], 5.0, atol=1e-5)  # upper half: depth, not distance
    assert message.centre_px == pytest.approx((7.5, 4.0))
    # from half of the 92 deg across the diagonal of 16 x 9 pixels
    assert message.focal_px == pytest.approx(2 * (math.hypot(16, 9) / 2 / math.tan(math.radians(46)),))


def test_drones_see_each_other_and_not_themselves():
    made = fleet((0, 0, 0), (3, 0, 0), obstacles=(), range={"max_m": 8, "beams": {"ahead": {}}})
    (seen,), (nothing,) = (taken(made, Range, drone).ranges_m for drone in (0, 1))
    assert seen == pytest.approx(3.0 - made.bodies.vehicle[1, VEHICLE.hull_radius], abs=1e-6)
    assert nothing == 0.0


def test_nothing_is_measured_outside_the_range_limits():
    for limits in ({"max_m": 4.99}, {"min_m": 5.01, "max_m": 8}):
        assert taken(fleet((0, 0, 0), range={"beams": {"a": {}}} | limits), Range).ranges_m == (0.0,)


@pytest.mark.parametrize(
    ("errors", "sigma"), [({"noise_m": 0.05}, 0.05), ({"noise_share": 0.02}, 0.1), ({"noise_1_m": 0.004}, 0.1)]
)
def test_noise_has_the_configured_sigma(errors: dict[str, float], sigma: float):
    """For 4000 beams at 5 m, sigma and mean are within 4 standard errors."""
    rate = {"beams": {f"b{i}": {"position_m": [0, 0, 1]} for i in range(50)}, "max_m": 8, "rate_hz": 50}
    made, seen = fleet((0, 0, 0), range=rate | errors), []
    for _ in range(80):
        seen += taken(made, Range).ranges_m
        made.advance()
    assert np.std(seen) == pytest.approx(sigma, rel=4 / math.sqrt(2 * len(seen)))
    assert np.mean(seen) == pytest.approx(5.0, abs=4 * sigma / math.sqrt(len(seen)))


def test_a_bias_is_common_to_the_beams_and_a_quantum_rounds_each_reading():
    several = {"beams": {"a": {}, "b": {"position_m": [1, 0, 0]}}, "max_m": 8}
    first, second = taken(fleet((0, 0, 0), range=several | {"bias_m": 0.1}), Range).ranges_m
    assert first - second == pytest.approx(1.0, abs=1e-6)
    assert first != pytest.approx(5.0, abs=1e-4)
    (rounded, _) = taken(fleet((0.03, 0, 0), range=several | {"quantum_m": 0.25}), Range).ranges_m
    assert rounded == 5.0


def test_rays_and_messages_are_lost_at_the_configured_rates():
    beams = {f"b{i}": {} for i in range(40)}
    missed = {"beams": beams, "max_m": 8, "rate_hz": 50, "miss": 0.25}
    made, lost = fleet((0, 0, 0), range=missed), 0
    for _ in range(50):
        lost += taken(made, Range).ranges_m.count(0.0)
        made.advance()
    assert lost / 2000 == pytest.approx(0.25, abs=4 * math.sqrt(0.25 * 0.75 / 2000))
    made, kept = fleet((0, 0, 0), range=missed | {"dropout": 0.5}), 0
    for _ in range(400):
        kept += len(made.observations)
        made.advance()
    assert kept / 400 == pytest.approx(0.5, abs=4 * math.sqrt(0.25 / 400))


def test_a_sample_is_measured_at_its_instant_and_delayed_by_its_latency():
    """The drone falls from 30 m; its downward beam measures the height at t_sample_ns, published 30 ms later."""
    down = {"beams": {"down": {"rpy_deg": [0, 90, 0]}}, "max_m": 50, "rate_hz": 1000 / 30, "latency_ms": 30}
    made, heights, seen = fleet((0, 0, 30), obstacles=(), range=down), {}, {}
    for _ in range(20):
        heights[made.t_ns] = float(made.truth().position_m[0, 2])
        for each in made.observations.values():
            message: Any = each.message(0)
            seen[each.t_sample_ns] = each.t_ns, message.ranges_m[0]
        made.advance()
    assert sorted(seen)[:4] == [0, 30_000_000, 60_000_000, 90_000_000]
    for t_sample_ns, (t_ns, height) in seen.items():
        assert t_ns == t_sample_ns + 30_000_000
        expected = np.interp(t_sample_ns, [*heights], [*heights.values()])  # 0.5 g (10 ms)^2 is 0.5 mm
        assert height == pytest.approx(expected, abs=1e-3)


def test_a_restored_fleet_scans_on_bit_identically():
    settings = {"noise_m": 0.1, "miss": 0.1, "latency_ms": 15, "rate_hz": 40}
    made, other = (fleet((0, 0, 1), lidar=settings) for _ in range(2))
    for _ in range(5):
        made.advance()
    restore(other, unpack(pack(saved_state(made))))
    for _ in range(5):
        made.advance()
        other.advance()
        assert [each.message(0) for each in other.observations.values()] == [
            each.message(0) for each in made.observations.values()
        ]


def test_a_first_scan_larger_than_all_other_messages_is_published_whole():
    """The scan must not be written beyond the end of the buffer."""
    made = fleet((0, 0, 1), (3, 0, 1), lidar={"channels": 64, "columns": 360})
    gate = GatePublication(made).gate([None, None])
    sizes = [len(payload) for key, payload in gate.pairs if key.endswith("/lidar")]
    assert len(sizes) == 2
    assert min(sizes) > 64 * 360 * 4


def test_dropout_and_bias_faults_affect_one_sensor_and_end() -> None:
    made = fleet((0, 0, 0), (0, 3, 0), range={"beams": {"ahead": {}}, "max_m": 8, "rate_hz": 50})
    made.advance()

    def faults(*kinds: tuple[str, dict[str, float]]) -> list[Fault]:
        return [Fault(k, kind, "d1", values, 0, None, "test") for k, (kind, values) in enumerate(kinds)]

    def ahead() -> list[float]:
        made.advance()
        return [message.ranges_m[0] for message in (taken(made, Range, drone) for drone in (0, 1))]

    for bias_m in (0.5, -0.25):
        made.impairment.strike(faults(("range_bias", {"value_m": bias_m}), ("lidar_bias", {"value_m": 9.0})))
        assert ahead() == pytest.approx([5.0, 5.0 + bias_m], abs=1e-3)
    made.impairment.strike(faults(("range_dropout", {"probability": 1.0})))
    made.advance()
    assert {each.drone for each in made.observations.values()} == {0}
    made.impairment.strike([])
    assert ahead() == pytest.approx([5.0, 5.0], abs=1e-3)


def test_noise_and_stuck_faults_affect_one_sensor_and_end() -> None:
    noisy = {"beams": {"ahead": {}}, "max_m": 8, "rate_hz": 50, "noise_m": 0.01}
    readings = {}
    for kind, values in {"": {}, "range_noise": {"factor": 3.0}, "range_stuck": {}}.items():
        made = fleet((0, 0, 0), (0, 3, 0), range=noisy)
        made.advance()
        made.impairment.strike([Fault(1, kind, "d1", values, 0, None, "test")] if kind else [])
        kept = []
        for gate in range(40):
            if gate == 20:
                made.impairment.strike([])
            made.advance()
            kept.append([taken(made, Range, drone).ranges_m[0] for drone in (0, 1)])
        readings[kind] = np.array(kept)
    sound, noise, stuck = readings.values()
    for struck in (noise, stuck):
        assert struck[20:].tolist() == sound[20:].tolist()  # the same draws with the fault as without
        assert struck[:, 0].tolist() == sound[:, 0].tolist()  # the other drone
    assert noise[:20, 1] - 5.0 == pytest.approx(3.0 * (sound[:20, 1] - 5.0), abs=2e-3)
    assert stuck[:20, 1].tolist() == [sound[0, 1]] * 20
