"""The picture of a run as arrays: poses, the plan view, and the paths that a formation would fly."""

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from refused import has_terms

from zsim.contract.flight_messages import DroneView, EstimateView, ViewCluster, ViewDrones
from zsim.math import frames
from zsim.presentation import drone_colours, rgb
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Surface
from zsim.scenario.surroundings import outline_of, packed
from zsim_agents.formation.spaces.scenario_space import cluster_space, scenario_space
from zsim_bridges.console import picture as pic
from zsim_bridges.console import scene
from zsim_bridges.console.histories import CanvasTrails
from zsim_bridges.console.picture import PreviewError, preview_of
from zsim_bridges.console.scene import DARK, LIGHT, LUMINANCE_MIN, lightened, linear, luminance

SCENARIOS = Path(__file__).parents[4] / "scenarios"
LEVEL = (1.0, 0.0, 0.0, 0.0)
RNG = np.random.default_rng(4)


def some_attitudes(count: int) -> np.ndarray:
    q = RNG.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def test_a_view_becomes_arrays_in_the_order_of_the_drones():
    views = tuple(DroneView(f"d{i}", (i, 2.0, 3.0), LEVEL, (1.0, 2.0, 3.0, 4.0), "flying", 80.0) for i in range(2))
    found = pic.drone_poses(ViewDrones(7, 0, views, ((1.0, 0.0, 0.0), (3.0, 0.0, 0.0))), ("d0", "d1"))
    assert found.t_ns == 7
    assert found.names == ("d0", "d1")
    assert found.p_W.tolist() == [[0, 2, 3], [1, 2, 3]]
    assert found.rotor.tolist() == [[1, 2, 3, 4, 0, 0, 0, 0]] * 2
    assert found.wind_W.tolist() == [2, 0, 0]

    some = tuple(
        DroneView(name, (1.0, 2.0, 3.0), LEVEL, (1.0, 2.0, 3.0, 4.0), "flying", 80.0) for name in ("d2", "stranger")
    )
    found = pic.drone_poses(ViewDrones(7, 0, some), ("d0", "d1", "d2"))
    assert found.present.tolist() == [False, False, True]
    assert found.p_W[2].tolist() == [1, 2, 3]
    assert found.q_WB.shape == (3, 4)
    assert not pic.drone_poses(ViewDrones(7, 0, ()), ("d0",)).present.any()


def test_radio_links_are_lines_between_present_drones():
    views = tuple(DroneView(f"d{i}", (i, 0.0, 0.0), LEVEL, (1.0,) * 4, "flying", 80.0) for i in (0, 1, 3))
    drones = pic.drone_poses(ViewDrones(7, 0, views), ("d0", "d1", "d2", "d3"))
    both, single = pic.radio_lines(
        ((1, 2), (0, 3, 4), (0,), (), (0, 1, 2, 3)), drones
    )  # the fifth entry is that of the station
    assert both[:, :, 0].tolist() == [[0, 1]]
    assert single[:, :, 0].tolist() == [[1, 3]]


def test_many_names_are_shown_by_their_numbers_if_these_are_unambiguous():
    many = range(10, 10 + pic.FULL_NAMES_MAX + 1)
    assert pic.shown_names([f"drone{i}" for i in many]) == [str(i) for i in many]
    assert pic.shown_names(["drone1", "drone2"]) == ["drone1", "drone2"]  # few enough for full names
    for names in (["drone", *(f"drone{i}" for i in many)], [*(f"{'abcdefghijklmn'[i % 14]}{i}" for i in many)]):
        assert pic.shown_names(names) == names


def test_rotors_sit_on_their_drone_and_turn_about_its_vertical_axis():
    hubs = np.array([(0.1, 0.1, 0.03), (0.1, -0.1, 0.03), (-0.1, -0.1, 0.03), (-0.1, 0.1, 0.03)])
    q = some_attitudes(5)
    p = RNG.normal(size=(5, 3))
    owners = np.repeat(np.arange(5), 4)
    places, turns = pic.rotor_poses(p[owners], q[owners], np.tile(hubs, (5, 1)), RNG.uniform(0, 6, 20))
    R = frames.rotation_matrix(q)
    for n in range(5):
        for k in range(4):
            assert places[4 * n + k] == pytest.approx(p[n] + R[n] @ hubs[k])
            assert frames.rotation_matrix(turns)[4 * n + k][:, 2] == pytest.approx(R[n][:, 2])


def test_rotors_turn_slowly_enough_to_show_their_direction():
    fastest, ways = np.full(4, 503.0), np.array([1.0, -1.0, 1.0, -1.0])  # rad/s, the maximum of the AR.Drone
    turned = pic.rotor_angles(np.zeros(4), fastest, ways, 0.1)  # 0.1 s, at the lowest picture rate of 10 Hz
    steps = np.abs((turned + math.pi) % math.tau - math.pi)
    assert (steps > 0.1).all()
    assert (steps < math.pi / 2).all()  # a two-bladed propeller looks the same after half a turn
    assert pic.rotor_angles(turned, fastest, ways, 0.0) == pytest.approx(turned)


def test_an_ellipsoid_is_the_covariance_at_two_sigma():
    R = frames.rotation_matrix(some_attitudes(1))[0]
    P = R @ np.diag([0.04, 0.25, 1.0]) @ R.T
    estimate = EstimateView("d", (1.0, 2.0, 3.0), tuple(P[np.triu_indices(3)]), 0.0, 0.1, {})
    balls = pic.ellipsoids([estimate])
    assert balls.p_W.tolist() == [[1, 2, 3]]
    assert sorted(balls.half_m[0]) == pytest.approx([0.4, 1.0, 2.0])
    axes = frames.rotation_matrix(balls.wxyz)[0]
    assert axes @ np.diag(balls.half_m[0] / 2) ** 2 @ axes.T == pytest.approx(P)

    samples = np.linalg.norm(RNG.normal(size=(200_000, 3)), axis=1)
    assert pytest.approx(float((samples < pic.SIGMAS).mean()), abs=0.004) == pic.SHARE_WITHIN
    assert f"{pic.SHARE_WITHIN:.0%}" == "74%"

    balls = pic.ellipsoids([])
    assert balls.p_W.shape == (0, 3)
    assert balls.wxyz.shape == (0, 4)


@pytest.mark.parametrize("name", ["step", "ring10", "triads", "grid30"])
def test_ghosts_are_drawn_at_the_desired_formation(name: str):
    scenario = scenario_file.load(SCENARIOS / f"{name}.yaml")
    cluster = scenario.clusters[0]
    space = scenario_space(scenario, cluster)
    c = space.specimen(4.0)
    view = ViewCluster(0, 0, "engaged", space.names, tuple(c), tuple(c), "")
    found = pic.ghosts(space, view)
    assert found is not None
    p_W, q = found
    assert space.difference(space.forward(p_W, frames.heading(q)), c) == pytest.approx(np.zeros(space.size), abs=1e-6)
    assert pic.ghosts(space, msgspec.structs.replace(view, phase="idle")) is None


def test_a_formation_is_drawn_with_its_sides_and_its_angle():
    p_W = np.array([(0.0, 0.0, 2.0), (3.0, 0.0, 2.0), (0.0, 4.0, 2.0)])
    found = pic.formation_shape(cluster_space(3), p_W, np.zeros(3))
    assert found is not None
    assert [side.name for side in found.sides] == ["p 3.00 m", "q 4.00 m", ""]
    assert found.sides[1].ends_W.tolist() == p_W[[0, 2]].tolist()
    assert found.corner is not None
    assert found.corner[1] == "β 90.0°"
    assert found.p_c == pytest.approx(p_W.mean(axis=0))

    line = np.array([(0.0, 0.0, 2.0), (3.0, 0.0, 2.0), (6.0, 0.0, 2.0)])
    assert pic.formation_shape(cluster_space(3), line, np.zeros(3)) is None

    found = pic.formation_shape(cluster_space(2), np.array([(0.0, 0.0, 2.0), (3.0, 0.0, 2.0)]), np.zeros(2))
    assert found is not None
    assert [side.name for side in found.sides] == ["p 3.00 m"]
    assert found.corner is None


SCENARIO = scenario_file.load(Path(__file__).parents[4] / "scenarios" / "step.yaml")
SPACE = scenario_space(SCENARIO, SCENARIO.clusters[0])
BASE = SPACE.specimen(4.0)
APART_M = 2.0


def changed(**values: float) -> np.ndarray:
    c = BASE.copy()
    for name, value in values.items():
        c[SPACE.index(name)] = value
    return c


def test_a_preview_shows_the_paths_and_their_figures():
    preview = preview_of(SPACE, "target", {"values": {"x_c": BASE[0] + 3.0, "yaw_deg": 90.0}}, BASE, APART_M)
    assert np.allclose(preview.paths_W[:, 0], SPACE.inverse(BASE)[0])
    goal = changed(x_c=BASE[0] + 3.0, yaw=np.pi / 2)
    assert np.allclose(preview.paths_W[:, -1], SPACE.inverse(goal)[0])
    assert "less than" not in preview.text

    waypoints = [
        {"at_s": 0.0, "values": {"x_c": 1.0, "z_c": 8.0}},
        {"at_s": 20.0, "values": {"x_c": 21.0, "z_c": 12.0}},
    ]
    preview = preview_of(SPACE, "trajectory", {"waypoints": waypoints}, BASE, APART_M)
    assert np.allclose(preview.paths_W[:, 0], SPACE.inverse(BASE)[0])
    assert np.allclose(preview.paths_W[:, -1], SPACE.inverse(changed(x_c=21.0, z_c=12.0))[0])
    # A cubic from rest to rest has a peak of 1.5 times its mean speed: 1.5 * hypot(20, 4) / 20.
    assert has_terms(preview.text, "20 s", "heights 8.0 to 12.0 m", "1.5 m/s at most")

    preview = preview_of(SPACE, "target", {"values": {"p": 1.0}}, BASE, APART_M)
    assert has_terms(preview.text, "1.0 m apart", "less than the 2 m")


@pytest.mark.parametrize(
    ("op", "args", "finding"),
    [
        ("target", {"values": {"speed": 1.0}}, "speed"),
        ("trajectory", {"expressions": {"x_c": "5*cos("}}, "x_c"),
        ("trajectory", {"waypoints": []}, "expressions or waypoints"),
    ],
)
def test_an_invalid_request_has_no_preview(op: str, args: dict[str, object], finding: str):
    with pytest.raises(PreviewError) as refused:
        preview_of(SPACE, op, args, BASE, APART_M)
    assert finding in str(refused.value)


# Colours of the scene

CONTRAST_MIN = 2.3  # of drawings against the ground; text, which is finer, needs 4.5 (WCAG 2.2)


def test_colours_of_lines_are_converted_to_linear_light() -> None:
    """Half the luminance of white is 188 of 255 in sRGB."""
    assert linear(np.array([[0, 188, 255], [5, 10, 128]])).tolist() == [[0, 128, 255], [0, 1, 55]]


@pytest.mark.parametrize("ground", [LIGHT[0], DARK[0]])
@pytest.mark.parametrize("part", ["cross", "hull", "rotor"])
def test_drones_contrast_with_the_ground_in_both_themes(ground: tuple[int, int, int], part: str):
    light, dark = sorted((luminance(scene.COLOURS[part]), luminance(ground)), reverse=True)
    assert (light + 0.05) / (dark + 0.05) > CONTRAST_MIN


@pytest.mark.parametrize("count", [3, 30])
def test_trails_contrast_with_dark_ground_and_light_colours_are_kept(count: int):
    for colour in map(rgb, drone_colours(count)):
        seen = lightened(colour)
        assert (luminance(seen) + 0.05) / (luminance(DARK[0]) + 0.05) > CONTRAST_MIN
        assert luminance(colour) < LUMINANCE_MIN or list(seen) == list(colour)


def test_reference_paths_are_lines_from_the_hover_to_the_end():
    scenario = scenario_file.load(SCENARIOS.parent / "examples" / "exchange.yaml")
    lines = pic.reference_lines(scenario)
    assert lines.shape == (4 * 2 * (pic.PATH_POINTS - 1), 2, 3)
    assert np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).max() < 0.6
    first = lines[: pic.PATH_POINTS - 1]
    assert first[0, 0] == pytest.approx([0, 0, 1])  # above its start
    assert isinstance(scenario.exchanges, list)
    ends = np.array(scenario.exchanges[0].stages[0].places_m)
    assert np.linalg.norm(ends - first[-1, 1], axis=1).min() < 1e-9
    assert len(pic.reference_lines(scenario_file.load(SCENARIOS / "step.yaml"))) == 0


# The plan view


FIELD = """
name: field
duration_s: 1
drones: [{name: drone1, position_m: [0, 0, 0]}, {name: drone2, position_m: [3, 0, 0]}]
environment:
  obstacles:
    - {name: wall, shape: box, position_m: [5, 1, 0], size_m: [1, 4, 3], yaw_deg: 30}
    - {name: mast, shape: cylinder, position_m: [9, 0, 0], radius_m: 0.2, height_m: 6}
"""
NORTH = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


def drone_view(name: str, x: float = 0.0) -> DroneView:
    return DroneView(name, (x, 2.0, 5.0), NORTH, (0.0,) * 4, "flying", 90.0)


def test_the_surroundings_list_drones_and_obstacles():
    scenario = scenario_file.from_text(FIELD)
    around = pic.surroundings(scenario)
    assert around["names"] == around["labels"] == ["drone1", "drone2"]
    assert len(set(around["colours"])) == 2
    wall, mast = around["obstacles"]
    assert wall == {"name": "wall", "x_m": 5.0, "y_m": 1.0, "yaw_deg": 30.0, "radius_m": None, "size_m": [1.0, 4.0]}
    assert (mast["x_m"], mast["radius_m"], mast["size_m"]) == (9.0, 0.2, None)
    assert around["surfaces"] == []
    corners = np.array([[0, 0, 0, 2, 0, 3, 2, 1, 0], [0, 0, 0, 2, 1, 0, 0, 1, 1], [1, 0.5, 9, 0, 0, 0, 1, 0, 0]], float)
    stone = Surface(name="stone", triangles=packed(corners), position_m=(5, 6, 0), yaw_deg=90)
    outline = [[4.0, 6.0], [5.0, 6.0], [5.0, 8.0], [4.0, 8.0]]
    assert outline_of(stone) == outline


def test_plan_positions_have_place_heading_and_state_of_visible_drones():
    poses = pic.drone_poses(ViewDrones(0, 0, (drone_view("drone2", 3.456),), ()), ("drone1", "drone2"))
    nobody, seen = pic.plan_positions(poses, {"drone2": "flying"})
    assert nobody is None
    assert seen == [3.46, 2.0, 5.0, 1.571, "flying"]


def test_a_formation_has_target_places_only_while_it_has_a_target():
    space = cluster_space(3)
    p_W = np.array([(0.0, 1.5, 5.0), (-1.5, -1.5, 5.0), (1.5, -1.5, 5.0)])
    c = tuple(space.forward(p_W, np.zeros(3)).tolist())
    views = {phase: ViewCluster(0, 0, phase, space.names, c, c, "") for phase in ("idle", "engaged")}
    shown: list[dict[str, Any]] = pic.plan_formations(
        {"idle": space, "engaged": space}, {"idle": [0, 1, 2], "engaged": [0, 1, 2]}, views
    )
    assert [each["phase"] for each in shown] == ["idle", "engaged"]
    assert shown[0]["places"] == []
    assert np.allclose(shown[1]["places"], p_W[:, :2])


def test_trails_are_the_recent_part_of_each_path():
    names, trails = ("drone1", "drone2"), CanvasTrails(2)
    poses = pic.drone_poses(ViewDrones(0, 0, (drone_view("drone1"),), ()), names)
    for x in range(4):
        poses = pic.drone_poses(ViewDrones(x * 10**9, 0, (drone_view("drone1", float(x)),), ()), names)
        trails.add(float(x), poses.p_W)
    way, nothing = trails.lines(3.0, poses.p_W)
    assert way == [
        [0.0, 2.0, 0.0],
        [1.0, 2.0, 1.0],
        [2.0, 2.0, 2.0],
    ]  # where segments begin; the last one ends at the drone
    assert nothing == []


def test_plan_positions_of_a_hundred_drones_are_small():
    """A page requests them ten times a second, at a few kilobytes each."""
    names = tuple(f"drone{i}" for i in range(1, 101))
    poses = pic.drone_poses(ViewDrones(0, 0, tuple(drone_view(name, 123.456) for name in names), ()), names)
    assert len(json.dumps(pic.plan_positions(poses, dict.fromkeys(names, "flying")))) < 6_000
