"""Forests, corridors, meshes, height maps and point clouds: the obstacles they generate, and what is refused."""

import struct
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refused import faulty_fields, has_terms

from zsim.errors import DocumentError
from zsim.scenario import scenario_file
from zsim.scenario.generated import triangles_of
from zsim.scenario.scenario_file import resolve
from zsim.scenario.surroundings import COLUMNS, nearest, packed, placed, row_of
from zsim.schema import plugin
from zsim_world.physics.rays import cast, scene

FOREST = {"trees": 60, "area_m": [-15, -15, 15, 15], "gap_m": 1.0, "clear_m": 3.0}
CORRIDOR = {"segments": 8, "turn_deg": 60, "start_m": [-2, 0]}
STARTS = ((0.0, 0.0), (4.0, 0.0))


def document(seed: int = 1, **environment: Any) -> dict[str, Any]:
    drones = [{"name": f"d{i}", "position_m": [x, y, 0]} for i, (x, y) in enumerate(STARTS)]
    return {"name": "t", "seed": seed, "duration_s": 1, "environment": environment, "drones": drones}


def obstacles(**given: Any) -> Any:
    return resolve(document(**given)).environment.obstacles


def test_trees_are_clear_of_each_other_and_of_the_starts():
    trees = obstacles(forest=FOREST)
    assert len({tree.name for tree in trees}) == 60
    places = np.array([tree.position_m[:2] for tree in trees])
    assert np.abs(places).max() <= 15
    for a, b in combinations(trees, 2):
        assert np.hypot(*np.subtract(a.position_m, b.position_m)[:2]) >= a.radius_m + b.radius_m + 1.0
    for tree in trees:
        assert min(np.hypot(*np.subtract(tree.position_m[:2], start)) for start in STARTS) >= tree.radius_m + 3.0


@pytest.mark.parametrize("part", [{"forest": FOREST}, {"corridor": CORRIDOR}])
def test_the_seed_of_the_scenario_or_section_determines_the_obstacles(part: dict[str, Any]):
    ((name, settings),) = part.items()
    assert obstacles(seed=1, **part) == obstacles(seed=1, **part) != obstacles(seed=2, **part)
    fixed = {name: settings | {"seed": 5}}
    assert obstacles(seed=1, **fixed) == obstacles(seed=2, **fixed)


def test_the_resolved_text_lists_generated_and_given_obstacles():
    ball = {"name": "ball", "shape": "sphere", "position_m": [0, 0, 9], "radius_m": 1}
    made = resolve(document(forest=FOREST, corridor=CORRIDOR | {"start_m": [30, 0]}, obstacles=[ball]))
    assert len(made.environment.obstacles) == 1 + 60 + 16
    assert scenario_file.from_text(scenario_file.to_text(made)) == made


def test_a_corridor_has_its_width_and_is_closed_at_its_bends():
    """Opposite walls are one width apart; consecutive walls overlap, so that there is no gap."""
    walls = list(obstacles(corridor=CORRIDOR))
    rows = [row_of(wall) for wall in walls]
    lefts, rights = ([wall for wall in walls if wall.name.endswith(side)] for side in ("left", "right"))
    for left, right in zip(lefts, rights, strict=True):
        yaw = np.radians(left.yaw_deg)
        across = np.array([-np.sin(yaw), np.cos(yaw)])
        apart = np.subtract(left.position_m, right.position_m)[:2] @ across
        assert apart == pytest.approx(3.0 + 0.2, abs=5e-3)
    for first, second in pairwise(lefts):  # each wall ends within the next
        yaw = np.radians(first.yaw_deg)
        end = np.array(first.position_m[:2]) + 0.5 * (first.size_m[0] - 0.2) * np.array([np.cos(yaw), np.sin(yaw)])
        assert nearest(rows[walls.index(second)], float(end[0]), float(end[1]), 1.0)[0] < 0.0


@pytest.mark.parametrize(
    ("section", "change", "field"),
    [
        ("forest", {"trees": 900}, "trees"),  # too many to fit
        ("forest", {"area_m": [5, 0, -5, 1]}, "area_m"),
        ("forest", {"radius_m": [0.3, 0.2]}, "radius_m"),
        ("forest", {"colour": 1}, "colour"),
        ("corridor", {"seed": 0.5}, "seed"),
    ],
)
def test_invalid_forests_and_corridors_are_refused(section: str, change: dict[str, Any], field: str):
    changed: Any = {section: {"forest": FOREST, "corridor": CORRIDOR}[section] | change}
    assert faulty_fields(document(**changed), "environment.") == [f"{section}.{field}"]


def test_more_obstacles_in_total_than_a_world_takes_are_refused():
    big: Any = {"forest": FOREST | {"trees": 999, "area_m": [-300, -300, 300, 300]}, "corridor": CORRIDOR}
    assert faulty_fields(document(**big), "environment.") == ["obstacles"]


CORNERS = np.array([[[0, -1, 0], [0, 1, 0], [0, 0, 2]], [[2, -1, 0], [2, 1, 0], [2, 0, 2]]], dtype="<f4")  # x = 0 and 2


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write the same two triangles in every mesh format, and height maps and clouds of other shapes."""
    monkeypatch.setenv(plugin.FOLDERS, "")
    plugin.search(tmp_path)
    facets = b"".join(struct.pack("<12fH", 0, 0, 0, *each.ravel(), 0) for each in CORNERS)
    (tmp_path / "binary.stl").write_bytes(bytes(80) + struct.pack("<I", len(CORNERS)) + facets)
    loops = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {} {} {}\n".format(*p) for p in each)
        + "endloop\nendfacet\n"
        for each in CORNERS.tolist()
    )
    (tmp_path / "text.stl").write_text(f"solid t\n{loops}endsolid t\n")
    points = CORNERS.reshape(-1, 3).tolist()
    vertices = "".join("v {} {} {}\n".format(*p) for p in points)
    (tmp_path / "mesh.obj").write_text(f"{vertices}f 1 2 3\nf 4 5 6\n")
    (tmp_path / "hill.csv").write_text("0,0,0\n0,3,0\n0,0,0\n")
    np.save(tmp_path / "hill.npy", [[0, 0, 0], [0, 3, 0], [0, 0, 0]])
    np.save(tmp_path / "complex.npy", np.full((3, 3), 1j))
    np.savez(tmp_path / "archive.npz", np.zeros((3, 3)))
    (tmp_path / "archive.npz").rename(tmp_path / "archive.npy")
    (tmp_path / "bad.csv").write_text("0,much\n")
    (tmp_path / "nan.csv").write_text("0,0\n0,nan\n")
    (tmp_path / "torn.stl").write_bytes(bytes(80) + struct.pack("<I", 9) + facets)
    (tmp_path / "points.csv").write_text("0.1,0.1,0.1\n0.4,0.2,0.7\n1.7,0.1,0.2\n9,9,nan\n")
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
    (tmp_path / "points.pcd").write_text(f"{head}POINTS 3\nDATA ascii\n0.1 0.1 0.1\n0.4 0.2 0.7\n1.7 0.1 0.2\n")
    properties = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "points.ply").write_text(f"ply\nformat ascii 1.0\n{properties}0.1 0.1 0.1\n0.4 0.2 0.7\n1.7 0.1 0.2\n")
    return tmp_path


def with_files(**environment: Any) -> dict[str, Any]:
    drones = [{"name": "d1", "position_m": [-9, 0, 0]}]
    return {"name": "t", "duration_s": 1, "environment": environment, "drones": drones}


def resolved(**environment: Any) -> Any:
    return resolve(with_files(**environment))


def seen(made: Any, o: Any, d: Any) -> float:
    triangles = np.concatenate([placed(each) for each in made.environment.surfaces])
    return cast(scene(np.empty((0, COLUMNS)), triangles), o, d, 50.0)


@pytest.mark.parametrize("file", ["binary.stl", "text.stl", "mesh.obj"])
def test_a_ray_hits_a_mesh_where_it_is_placed(file: str):
    pytest.importorskip("trimesh")
    made = resolved(surfaces=[{"name": "m", "file": file, "position_m": [5, 3, 0], "yaw_deg": 90, "scale": 2}])
    assert seen(made, (5.0, -4.0, 1.0), (0.0, 1.0, 0.0)) == pytest.approx(7.0, abs=1e-6)  # after the turn, at y = 3
    assert seen(made, (5.0, 4.0, 1.0), (0.0, 1.0, 0.0)) == pytest.approx(3.0, abs=1e-6)  # and at y = 3 + 2 * 2
    assert seen(made, (5.0, -4.0, 4.1), (0.0, 1.0, 0.0)) == 50.0  # above its top


@pytest.mark.parametrize("file", ["hill.csv", "hill.npy"])
def test_a_height_map_is_linear_between_its_heights(file: str):
    made = resolved(surfaces=[{"name": "hill", "file": file, "cell_m": 4}])
    for x, y, height in ((0.0, 0.0, 3.0), (2.0, 0.0, 1.5), (0.0, -1.0, 2.25), (3.9, 3.9, 0.075)):
        assert seen(made, (x, y, 9.0), (0.0, 0.0, -1.0)) == pytest.approx(9.0 - height, abs=1e-5)


def test_the_resolved_text_needs_no_file(folder: Path):
    made = resolved(surfaces=[{"name": "hill", "file": "hill.csv", "cell_m": 4}])
    text = scenario_file.to_text(made)
    (folder / "hill.csv").unlink()
    assert scenario_file.from_text(text) == made


@pytest.mark.parametrize("file", ["points.csv", "points.pcd", "points.ply"])
def test_a_point_cloud_becomes_boxes_of_its_occupied_cells(file: str):
    """Of the occupied cells of 0.5 m, two on top of each other form one box, and the third is separate."""
    if not file.endswith("csv"):
        pytest.importorskip("trimesh")
        pytest.importorskip("pypcd4")
    first, second = resolved(cloud={"file": file, "cell_m": 0.5, "position_m": [2, 0, 0]}).environment.obstacles
    assert (first.position_m, first.size_m) == ((2.25, 0.25, 0.0), (0.5, 0.5, 1.0))
    assert (second.position_m, second.size_m) == ((3.75, 0.25, 0.0), (0.5, 0.5, 0.5))


@pytest.mark.parametrize(
    ("environment", "field"),
    [
        ({"surfaces": [{"name": "m"}]}, "surfaces[0].file"),
        ({"surfaces": [{"name": "m", "file": "nowhere.csv", "cell_m": 1}]}, "surfaces[0].file"),
        ({"surfaces": [{"name": "m", "file": "hill.txt"}]}, "surfaces[0].file"),
        ({"surfaces": [{"name": "m", "file": "hill.csv"}]}, "surfaces[0].file"),  # without cell_m
        ({"surfaces": [{"name": "m", "file": "bad.csv", "cell_m": 1}]}, "surfaces[0].file"),
        ({"surfaces": [{"name": "m", "file": "nan.csv", "cell_m": 1}]}, "surfaces[0].file"),
        ({"surfaces": [{"name": "m", "file": "torn.stl"}]}, "surfaces[0].file"),
        ({"surfaces": [{"name": "m", "file": 5}]}, "surfaces[0].file"),
        ({"surfaces": [{"name": "m", "file": "complex.npy", "cell_m": 1}]}, "surfaces[0].file"),
        ({"surfaces": [{"name": "m", "file": "archive.npy", "cell_m": 1}]}, "surfaces[0].file"),
        ({"surfaces": [{"name": "m", "triangles": "no"}]}, "surfaces[0].triangles"),
        ({"surfaces": [{"name": "m", "triangles": packed(np.ones((4, 9)))[:-8]}]}, "surfaces[0].triangles"),
        ({"surfaces": [{"name": "m", "triangles": packed(np.full((1, 9), np.nan))}]}, "surfaces[0].triangles"),
        ({"surfaces": [{"name": "m", "triangles": packed(np.ones((400_000, 9)))}]}, "surfaces[0].triangles"),
        ({"surfaces": [{"name": "m", "file": "hill.csv", "cell_m": 1}] * 2}, "surfaces[1].name"),
        ({"cloud": {"file": "nowhere.csv", "cell_m": 1}}, "cloud.file"),
        ({"cloud": {"file": "hill.npy", "cell_m": 1}}, "cloud.file"),
    ],
)
def test_invalid_files_and_triangles_are_refused(environment: dict[str, Any], field: str):
    found = faulty_fields(with_files(**environment), "environment.")
    assert field in found
    assert {each.partition(".")[0] for each in found} == {field.partition(".")[0]}


def test_more_triangles_than_a_scenario_can_carry_are_refused(folder: Path):
    np.save(folder / "large.npy", np.zeros((200, 200)))
    surfaces = [{"name": "m", "file": "large.npy", "cell_m": 1}]
    assert faulty_fields(with_files(surfaces=surfaces)) == ["environment.surfaces"]


def test_a_bad_binary_stl_is_refused_with_its_size_or_triangle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One file is truncated, and in another the second triangle has a NaN."""
    triangle = np.array([0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0], "<f4")
    bad = triangle.copy()
    bad[4] = np.nan
    head = bytes(80) + (2).to_bytes(4, "little")
    monkeypatch.chdir(tmp_path)
    path = Path("rock.stl")
    for content, finding in (
        (triangle.tobytes(), "132"),
        (triangle.tobytes() + b"\0\0" + bad.tobytes() + b"\0\0", "2"),
    ):
        path.write_bytes(head + content)
        with pytest.raises(DocumentError) as raised:
            triangles_of(path, "environment.surfaces[0].file", None)
        assert has_terms(raised.value.faults[0], "environment.surfaces[0].file", "'rock.stl'", finding)


def test_a_height_that_is_not_finite_is_reported_with_row_and_column(tmp_path: Path) -> None:
    heights = np.zeros((4, 5))
    heights[2, 3] = np.nan
    np.save(tmp_path / "hill.npy", heights)
    with pytest.raises(DocumentError) as raised:
        triangles_of(tmp_path / "hill.npy", "environment.surfaces[0].file", 1.0)
    assert has_terms(raised.value.faults[0], "environment.surfaces[0].file", "row 3", "column 4")
