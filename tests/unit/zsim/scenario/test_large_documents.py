"""Large documents that are not scenarios are refused quickly, whatever fills them."""

import time
from pathlib import Path

import pytest
import yaml
from refused import has_terms

from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import (
    CLUSTERS_MAX,
    CONSTANTS_MAX,
    DRONES_MAX,
    FAULTS_MAX,
    OBSTACLES_MAX,
    PROCESSES_MAX,
    ROBOTS_MAX,
    VARIABLES_MAX,
    WAYPOINTS_MAX,
)
from zsim.schema import yaml_file
from zsim.schema.yaml_file import VALUES_MAX

SIZE = 250_000  # bytes
SIZE_OF_MOST = 1_000_000  # bytes, size of documents that exceed VALUES_MAX or WAYPOINTS_MAX
PARSINGS = 20  # limit of a refusal's CPU time, as a multiple of libyaml's for a plain document of the same size
PAIR = """name: pair
duration_s: 10
drones:
- {name: drone1, position_m: [2, 0, 0]}
- {name: drone2, position_m: [-2, 0, 0]}
"""
MANY = "name: many\nduration_s: 10\ndrones:\n" + "".join(
    f"- {{name: d{i}, position_m: [{3 * (i % 32)}, {3 * (i // 32)}, 0]}}\n" for i in range(DRONES_MAX)
)
TRAJECTORY = PAIR + "clusters: [{name: main, drones: [drone1, drone2], plan: {takeoff_s: 0.5, trajectory: {"
CLUSTER = PAIR + "clusters:\n- {name: main, drones: [drone1, drone2], %s}"


@pytest.fixture(scope="module")
def refused_s() -> float:
    """CPU time [s] per byte within which a document must be refused, derived from libyaml's for plain ones."""
    start_s = time.process_time()
    yaml.load(numbered("", "k{}: 1\n"), yaml.CSafeLoader)
    return PARSINGS * (time.process_time() - start_s) / SIZE


def filled(head: str, unit: str, tail: str = "", size: int = SIZE) -> str:
    return head + unit * ((size - len(head) - len(tail)) // len(unit)) + tail


def numbered(head: str, unit: str, tail: str = "", size: int = SIZE) -> str:
    return head + "".join(unit.format(i) for i in range((size - len(head) - len(tail)) // (len(unit) + 4))) + tail


# name: (text, terms that one line must show)
TEXTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "almost a number": (filled(PAIR + "seed: ", "1", "x"), ("seed",)),
    "almost a fraction": (PAIR + "seed: " + "1" * (SIZE // 2) + "." + "1" * (SIZE // 2) + "x", ("seed",)),
    "directives": (numbered("", "%TAG !{}! tag:x\n", "---\na: 1"), ("YAML", "directives")),
    "short values": (filled("a: [", "1,", "]", SIZE_OF_MOST), ("line 1", str(VALUES_MAX))),
    "short pairs": (filled("a: [", "a: 1,", "]", SIZE_OF_MOST), ("line 1", str(VALUES_MAX))),
    "unknown keys": (numbered(PAIR, "k{}: 1\n"), ("k0",)),
    "models": (numbered("name: a\nduration_s: 1\ndrones:\n", "- {{model: m{}.x}}\n"), ("drones", "1", str(DRONES_MAX))),
    "clusters": (filled(PAIR + "clusters: [", "{},", "]"), ("clusters", "0", str(CLUSTERS_MAX))),
    "groups": (
        numbered(CLUSTER.removesuffix("%s}") + "groups: [", "{{name: g{}, size: 2}},", "]}"),
        ("clusters[0].groups", str(ROBOTS_MAX // 2)),
    ),
    "places": (
        filled(CLUSTER.removesuffix("%s}") + "template_m: [", "[1,2.5,30.25],", "]}"),
        ("clusters[0].template_m", str(ROBOTS_MAX)),
    ),
    "processes": (
        numbered(MANY + "processes: {expect: [", "estimator.x{},", "]}"),
        ("processes.expect", str(PROCESSES_MAX)),
    ),
    "policies": (
        numbered(PAIR + "processes: {on_death: {", "e{}: 1,", "}}"),
        ("processes.on_death", str(PROCESSES_MAX)),
    ),
    "faults": (filled(PAIR + "faults: [", "{kind: gust, target: world, at_s: 1},", "]"), ("faults", str(FAULTS_MAX))),
    "expressions": (
        numbered(TRAJECTORY + "expressions: {", "x{}: t,", "}}}}]"),
        ("clusters[0].plan.trajectory.expressions", str(VARIABLES_MAX)),
    ),
    "constants": (
        numbered(TRAJECTORY + "expressions: {x_c: t}, constants: {", "c{}: 1,", "}}}}]"),
        ("clusters[0].plan.trajectory.constants", str(CONSTANTS_MAX)),
    ),
    "waypoints": (
        numbered(TRAJECTORY + "waypoints: [", "{{at_s: {}, values: {{x_c: 0}}}},", "]}}}]", SIZE_OF_MOST),
        ("clusters[0].plan.trajectory.waypoints", str(WAYPOINTS_MAX)),
    ),
    "fields of a fault": (numbered(PAIR + "faults: [{kind: gps_dropout, ", "k{}: 1,", "}]"), ("faults[0].k0",)),
}


@pytest.mark.parametrize("name", TEXTS)
def test_a_large_invalid_document_is_refused_quickly(tmp_path: Path, refused_s: float, name: str) -> None:
    text, terms = TEXTS[name]
    path = tmp_path / "own.yaml"
    path.write_text(text)
    start_s = time.process_time()
    with pytest.raises(ScenarioError) as caught:
        scenario_file.load(path)
    assert time.process_time() - start_s < refused_s * len(text)
    assert any(has_terms(line, *terms) for line in caught.value.faults), caught.value.faults[0]


def test_a_thousand_obstacles_and_a_thousand_drones_are_checked_quickly(tmp_path: Path, refused_s: float) -> None:
    spheres = "".join(
        f"{{name: o{i}, shape: sphere, radius_m: 1, position_m: [0, 0, 0]}}," for i in range(OBSTACLES_MAX)
    )
    path = tmp_path / "own.yaml"
    path.write_text(f"{MANY}environment: {{obstacles: [{spheres}]}}")
    start_s = time.process_time()
    with pytest.raises(ScenarioError) as caught:
        scenario_file.load(path)
    assert time.process_time() - start_s < refused_s * SIZE_OF_MOST
    assert has_terms(caught.value.faults[0], "drones[0].position_m", "-1.00", "'o0'")


@pytest.mark.parametrize("path", ["a" + ".a" * 60_000, "a" + "[a]" * 40_000], ids=["words", "brackets"])
def test_an_override_with_a_very_long_path_is_refused(tmp_path: Path, path: str) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(PAIR)
    with pytest.raises(ScenarioError) as caught:
        scenario_file.load(file, [f"{path}=1"])
    assert has_terms(caught.value.faults[0], str(len(path)), "1000")


def test_a_resolved_scenario_of_a_thousand_drones_is_read_from_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`zsim run` passes it to its world that way; here scenario and limits are an eighth as large."""
    monkeypatch.setattr(yaml_file, "VALUES_MAX", VALUES_MAX // 8)
    monkeypatch.setattr(yaml_file, "FILE_SIZE_MAX", yaml_file.FILE_SIZE_MAX // 8)
    path = tmp_path / "many.yaml"
    path.write_text("\n".join(MANY.splitlines()[: 3 + DRONES_MAX // 8]))
    scenario = scenario_file.load(path)
    assert len(scenario.drones) == DRONES_MAX // 8
    path.write_text(scenario_file.to_text(scenario))
    assert scenario_file.load(path) == scenario
