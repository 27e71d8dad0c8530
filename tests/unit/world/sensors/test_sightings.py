"""Sightings: which hats are in view, when pictures are taken, their errors, and snapshots of the random state."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from continued import continue_from
from numpy.typing import NDArray

from zsim.math.frames import quaternion_from_rpy
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Obstacle, Scenario
from zsim.scenario.surroundings import COLUMNS, TRIANGLE, row_of
from zsim.sensors.camera import FrontCamera
from zsim.sensors.camera_model import camera_pose, lens_of
from zsim_world.physics.fleet_arrays import STATE
from zsim_world.physics.rays import scene
from zsim_world.sensors.sightings import POINTS, VIEW, MountedCamera, PictureSightings, SightingSampler, hats_in_view

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
    """Return the states of three drones at rest in the air, of which the first sees the others."""
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


def test_pictures_are_taken_at_the_camera_rate_and_arrive_with_its_latency():
    sightings = of(sampled(made("sensors.front_camera.latency_ms=50", "sensors.sightings.latency_ms=7"), range(51)), 0)
    assert [each.t_sample_ns for each in sightings] == [round(n * 1e9 / 15) for n in range(15)]
    assert {each.t_ns - each.t_sample_ns for each in sightings} == {57_000_000}


def test_a_drone_that_looks_away_publishes_empty_sightings():
    assert [len(each.seen) for each in of(sampled(made(), range(51)), 1)] == [0] * 16


def errors(*fields: str) -> NDArray[np.float64]:
    """Return the errors of the sightings of a drone in sigmas: range, direction to the left and upwards; (M, 3)."""
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
def test_the_errors_match_the_reported_sigmas(fields: tuple[str, ...]):
    found = errors(*fields)
    count = len(found)
    assert np.mean(found, 0) == pytest.approx([0, 0, 0], abs=4 / np.sqrt(count) + 0.15)  # ranges are slightly skewed
    assert np.std(found, 0) == pytest.approx([1, 1, 1], rel=0.1)


def test_misses_occur_at_the_configured_probability():
    sightings = of(sampled(made("sensors.sightings.miss=0.2"), range(5000)), 0)
    assert np.mean([len(each.seen) for each in sightings]) == pytest.approx(1.6, abs=0.06)


def test_false_alarms_occur_at_the_configured_rate_all_over_the_picture():
    sightings = of(sampled(made("sensors.sightings.false_hz=3", "sensors.sightings.miss=1"), range(5000)), 0)
    seen = [each for sighting in sightings for each in sighting.seen]
    assert len(seen) / 100.0 == pytest.approx(3.0, abs=0.6)
    y = np.array([each.direction_B[1] for each in seen])
    assert y.min() < -0.5 < 0.5 < y.max()


def test_sightings_are_ordered_from_left_to_right_and_not_by_drone():
    swapped = still()
    swapped[[1, 2]] = swapped[[2, 1]]
    for state in (still(), swapped):
        for each in of(sampled(made(), range(51), state), 0):
            lefts = [seen.direction_B[1] for seen in each.seen]
            assert lefts == sorted(lefts, reverse=True)


def test_sightings_continue_identically_from_a_snapshot():
    fields = ("sensors.sightings.false_hz=2", "sensors.front_camera.latency_ms=90")
    whole = sampled(made(*fields), range(200))
    first, second = made(*fields), made(*fields)
    before = sampled(first, range(101))
    continue_from(first, second)
    after: list[Any] = sampled(second, range(101, 200))
    assert before + after == whole


HAT_B, DIAMETER_M, HULL_M = (-0.03, 0.0, 0.11), 0.14, 0.26
LENS_B = (0.162, 0.0, 0.012)  # position of the lens of the front camera


def pose(x: float, y: float, z: float, rpy_deg: tuple[float, float, float] = (0, 0, 0)) -> NDArray[np.float64]:
    row = np.zeros(STATE.size)
    row[:3], row[STATE.q_WB : STATE.q_WB + 4] = (x, y, z), quaternion_from_rpy(np.radians(rpy_deg))
    return row


def look(
    poses: list[NDArray[np.float64]],
    balls: list[tuple[float, float, float]] | None = None,
    bare: list[bool] | None = None,
    obstacles: list[Obstacle] | None = None,
    triangles: list[list[tuple[float, float, float]]] | None = None,
) -> NDArray[np.float64]:
    """Return the table of what the front camera of the first drone has in view."""
    at, camera = camera_pose(FrontCamera()), FrontCamera()
    x, y, z = at.p_BK.tolist()
    w, i, j, k = at.q_BK
    mounted = MountedCamera(lens_of(camera), (x, y, z), (w, i, j, k))
    view = np.zeros((len(poses) + len(balls or []), VIEW.size))
    rows = np.array([row_of(each) for each in obstacles or []]).reshape(-1, COLUMNS)
    corners = np.array(triangles or []).reshape(-1, 3, 3)
    sheet = np.concatenate([corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
    around = scene(rows, sheet.reshape(-1, TRIANGLE))
    spheres, seen = np.array(balls or []).reshape(-1, 3), np.array(bare or [True] * len(poses))
    hulls = np.full(len(poses), HULL_M)
    hats_in_view(mounted, 0, np.array(poses), hulls, HAT_B, DIAMETER_M, spheres, seen, around, view)
    return view


def test_a_hat_ahead_is_seen_where_it_is():
    view = look([pose(0, 0, 5), pose(4, 1, 5.5)])
    to_B = np.array([4 + HAT_B[0] - LENS_B[0], 1.0, 0.5 + HAT_B[2] - LENS_B[2]])
    away = float(np.linalg.norm(to_B))
    assert view[:, VIEW.seen].tolist() == [0.0, 1.0]
    to_K = view[1, VIEW.direction_K : VIEW.direction_K + 3]
    assert to_K == pytest.approx(np.array([-to_B[1], -to_B[2], to_B[0]]) / away)
    assert view[1, VIEW.range] == pytest.approx(away)
    assert view[1, VIEW.angle] == pytest.approx(2 * math.asin(DIAMETER_M / 2 / away))


@pytest.mark.parametrize(("yaw_deg", "seen"), [(0, 1), (40, 1), (42, 0), (-40, 1), (-42, 0), (180, 0)])
def test_a_hat_is_seen_within_the_picture_s_width(yaw_deg: float, seen: int):
    # 92 deg across the diagonal of 640 x 360 are 84.2 deg across the width, less that of the hat itself; all is level
    view = look(
        [
            pose(
                -LENS_B[0] * math.cos(math.radians(yaw_deg)),
                -LENS_B[0] * math.sin(math.radians(yaw_deg)),
                0,
                (0, 0, yaw_deg),
            ),
            pose(4 - HAT_B[0], 0, LENS_B[2] - HAT_B[2]),
        ]
    )
    assert view[1, VIEW.seen] == seen


def test_a_covered_hat_is_not_seen_but_a_ball_is():
    view = look([pose(0, 0, 5), pose(4, 0, 5)], balls=[(3.0, 1.0, 5.0)], bare=[True, False])
    assert view[:, VIEW.seen].tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize(("height_m", "seen"), [(0.03, 0), (0.1, 0), (0.5, 1), (-0.5, 1)])
def test_a_hull_in_between_hides_a_hat(height_m: float, seen: int):
    """The middle drone is in the line of sight, which rises by 0.1 m over 4 m, or above or below it."""
    view = look([pose(0, 0, 5), pose(4, 0, 5), pose(2, 0, 5 + height_m)], bare=[True, True, False])
    assert view[1, VIEW.seen] == seen


def test_a_hat_is_hidden_from_below_by_its_own_hull():
    view = look([pose(0, 0, 5, (0, -30, 0)), pose(0.8, 0, 6.5)])
    assert view[1, VIEW.seen] == 0.0


RIM_M = 1.15 * HULL_M, 0.14 * HULL_M  # radius and height of the rotors' rim


@pytest.mark.parametrize("below_deg", [-10.0, 0.0, 4.0, 8.0, 12.0])
def test_a_hat_is_hidden_from_its_lower_edge_upwards_by_its_own_rotors(below_deg: float):
    """A straight edge hides an arc of the hat, set by the height of the rim's near edge above the hat's lower edge."""
    slope = math.tan(math.radians(below_deg))
    view = look([pose(-LENS_B[0], 0, 5 - LENS_B[2]), pose(4.0 - HAT_B[0], 0, 5 + 4.0 * slope - HAT_B[2])])
    hidden_m = RIM_M[1] + (RIM_M[0] + HAT_B[0]) * slope - (HAT_B[2] - DIAMETER_M / 2)
    cut = min(max(hidden_m / DIAMETER_M, 0.0), 1.0) if below_deg > 0 else 0.0
    arc = 1 - math.acos(1 - 2 * cut) / math.pi
    beside = 2 / POINTS if cut else 0.0  # the points next to the hidden arc are left out
    row = view[1]
    assert row[VIEW.share] == pytest.approx(arc - beside, abs=2 / POINTS)
    assert (row[VIEW.centre] > 1.0, row[VIEW.radius] > 1.0) == (cut > 0, cut > 0)


def test_the_errors_of_a_half_visible_circle_are_those_of_least_squares():
    """A wall hides the right half; the errors of a circle through 15 of 32 points are those of (A^T A)^-1."""
    wall = Obstacle(name="wall", shape="box", position_m=(2, -1.0001, 0), size_m=(0.01, 2, 20))
    view = look([pose(0, 0, 5), pose(4, 0, 5)], obstacles=[wall])[1]
    count = round(view[VIEW.share] * POINTS)
    turns = 2 * math.pi * (np.arange(count) - (count - 1) / 2) / POINTS
    A = np.column_stack([np.cos(turns), np.sin(turns), np.ones(count)])
    of_part = np.diag(np.linalg.inv(A.T @ A))
    assert count in (13, 14, 15)
    assert view[VIEW.centre] == pytest.approx(math.sqrt((of_part[0] + of_part[1]) / 2 / (2 / POINTS)), rel=1e-6)
    assert view[VIEW.radius] == pytest.approx(math.sqrt(of_part[2] * POINTS), rel=1e-6)


OBSTACLES = [
    Obstacle(name="box", shape="box", position_m=(2, 0, 0), size_m=(0.2, 2, 10)),
    Obstacle(name="pole", shape="cylinder", position_m=(2, 0, 0), radius_m=0.1, height_m=10),
    Obstacle(name="ball", shape="sphere", position_m=(2, 0, 5.05), radius_m=0.3),
]


@pytest.mark.parametrize("obstacle", OBSTACLES, ids=lambda obstacle: obstacle.name)
@pytest.mark.parametrize(("y", "seen"), [(0.0, 0), (6.0, 1)])
def test_an_obstacle_in_between_hides_a_hat(obstacle: Obstacle, y: float, seen: int):
    """The second pair stands beside the obstacle."""
    view = look([pose(0, y, 5), pose(4, y, 5)], obstacles=[obstacle])
    assert view[1, VIEW.seen] == seen


@pytest.mark.parametrize(("below_m", "share"), [(-0.06, 1.0), (0.0, 0.5), (0.06, 0.0)])
def test_a_hill_in_between_hides_the_part_of_a_hat_below_its_crest(below_m: float, share: float):
    """The crest is midway between lens and hat, this far above their line of sight; the hat is 14 cm in diameter."""
    line_m = 0.5 * (5 + LENS_B[2] + 5 + HAT_B[2])
    x, z = 0.5 * (LENS_B[0] + 4 + HAT_B[0]), line_m + below_m
    slopes = [[(x, -9.0, z), (x, 9.0, z), (x + side, 0.0, 0.0)] for side in (-1.0, 1.0)]
    row = look([pose(0, 0, 5), pose(4, 0, 5)], triangles=slopes)[1]
    beside = 2 / POINTS if share == 0.5 else 0.0  # the points next to the hidden part are left out
    assert row[VIEW.share] == pytest.approx(share - beside, abs=1 / POINTS)
    assert row[VIEW.seen] == (share > 0.0)


def test_the_rate_in_the_picture_follows_from_motion_and_rotation():
    watcher, other = pose(0, 0, 5), pose(4, 0, 5)
    away = 4 + HAT_B[0] - LENS_B[0]
    other[STATE.v_WB + 1] = 2.0
    assert look([watcher, other])[1, VIEW.rate] == pytest.approx(2.0 / away, rel=0.01)
    watcher[STATE.w_WB_B + 2] = 0.5
    watcher[STATE.v_WB : STATE.v_WB + 3] = other[STATE.v_WB : STATE.v_WB + 3]
    assert look([watcher, other])[1, VIEW.rate] == pytest.approx(0.5 * (1 + LENS_B[0] / away), rel=0.01)
