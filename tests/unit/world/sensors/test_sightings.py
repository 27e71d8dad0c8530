"""Sightings: when pictures are taken, what errors they have, and that chance goes on where it was."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from continued import continue_from
from numpy.typing import NDArray

from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_world.physics.rays import scene
from zsim_world.sensors.sightings import PictureSightings, SightingSampler

GATE_NS = 20_000_000
SCENARIO = """
name: two
seed: 5
duration_s: 10
sensors: {front_camera: {rate_hz: 15}, sightings: {}}
drones:
  - {name: d1, position_m: [0, 0, 0]}
  - {name: d2, position_m: [4, 0.5, 0]}
  - {name: d3, position_m: [4, -0.5, 0]}
processes: {expect: []}
"""


def scenario(*fields: str) -> Scenario:
    with TemporaryDirectory() as folder:
        place = Path(folder) / "two.yaml"
        place.write_text(SCENARIO)
        return scenario_file.load(place, fields)


def still() -> NDArray[np.float64]:
    """Return the states of three drones that stand in the air; the first sees the others."""
    state = np.zeros((3, 13))
    state[:, :3] = [(0, 0, 5), (4, 0.5, 5), (4, -0.5, 5)]
    state[:, 6] = 1.0
    return state


def sampled(sampler: SightingSampler, gates: range, state: NDArray[np.float64] | None = None) -> list[PictureSightings]:
    state = still() if state is None else state
    return [sighting for gate in gates for sighting in sampler.due(state, gate * GATE_NS)]


def made(*fields: str) -> SightingSampler:
    return SightingSampler(scenario(*fields), np.full(3, 0.26), scene(np.empty(0), np.empty(0)))


def of(sightings: list[PictureSightings], drone: int) -> list[PictureSightings]:
    return [sighting for sighting in sightings if sighting.drone == drone]


def test_pictures_are_taken_at_the_camera_s_rate_between_gates_and_come_with_its_latency():
    sightings = of(sampled(made("sensors.front_camera.latency_ms=50", "sensors.sightings.latency_ms=7"), range(51)), 0)
    assert [each.t_sample_ns for each in sightings] == [round(n * 1e9 / 15) for n in range(15)]
    assert {each.t_ns - each.t_sample_ns for each in sightings} == {57_000_000}


def test_who_looks_away_sees_nobody_and_says_so():
    assert [len(each.seen) for each in of(sampled(made(), range(51)), 1)] == [0] * 16


def errors(*fields: str) -> NDArray[np.float64]:
    """Return what is seen of a drone, less what is there, in sigmas: range, direction to the left and up; (M, 3)."""
    rows = []
    for each in of(sampled(made(*fields, "environment.hats.covered=[d3]"), range(5000)), 0):
        for seen in each.seen:
            r = np.array([4 - 0.03 - 0.162, 0.5, 0.11 - 0.012])
            away = np.linalg.norm(r)
            d = np.array(seen.direction_B)
            left = np.cross([0, 0, 1], r / away)
            left /= np.linalg.norm(left)
            up = np.cross(r / away, left)
            sigma = seen.sigma_direction_rad
            rows.append(((seen.range_m - away) / seen.sigma_range_m, d @ left / sigma, d @ up / sigma))
    return np.array(rows)


@pytest.mark.parametrize("fields", [(), ("environment.light=0.1",)], ids=["day", "dusk"])
def test_the_errors_are_as_large_as_they_say(fields: tuple[str, ...]):
    found = errors(*fields)
    count = len(found)
    assert np.mean(found, 0) == pytest.approx([0, 0, 0], abs=4 / np.sqrt(count) + 0.15)  # ranges are a little skewed
    assert np.std(found, 0) == pytest.approx([1, 1, 1], rel=0.1)


def test_misses_come_as_often_as_they_should():
    sightings = of(sampled(made("sensors.sightings.miss=0.2"), range(5000)), 0)
    assert np.mean([len(each.seen) for each in sightings]) == pytest.approx(1.6, abs=0.06)


def test_false_alarms_come_as_often_as_they_should_and_anywhere():
    sightings = of(sampled(made("sensors.sightings.false_hz=3", "sensors.sightings.miss=1"), range(5000)), 0)
    seen = [each for sighting in sightings for each in sighting.seen]
    assert len(seen) / 100.0 == pytest.approx(3.0, abs=0.6)
    y = np.array([each.direction_B[1] for each in seen])
    assert y.min() < -0.5 < 0.5 < y.max()


def test_what_is_seen_stands_from_left_to_right_whosever_it_is():
    swapped = still()
    swapped[[1, 2]] = swapped[[2, 1]]
    for state in (still(), swapped):
        for each in of(sampled(made(), range(51), state), 0):
            lefts = [seen.direction_B[1] for seen in each.seen]
            assert lefts == sorted(lefts, reverse=True)


def test_it_goes_on_from_a_snapshot():
    fields = ("sensors.sightings.false_hz=2", "sensors.front_camera.latency_ms=90")
    whole = sampled(made(*fields), range(200))
    first, second = made(*fields), made(*fields)
    before = sampled(first, range(101))
    continue_from(first, second)
    after: list[Any] = sampled(second, range(101, 200))
    assert before + after == whole
