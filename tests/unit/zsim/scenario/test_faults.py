"""Kinds of faults: each with its parameters, and each flaw reported in one line."""

import math
import re
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from refused import has_terms

from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.faults import KINDS, FaultParameter, Known, acts, expected, flaws, planned
from zsim.scenario.scenario_file import resolve
from zsim.sensors.scanner import SCANNERS

GATE_NS = 20_000_000
KNOWN = Known(("drone1", "drone2"), ("main",), ("my.filter",), rotors={"drone2": ("r1", "r2")})
TARGETS = {
    "drone": "drone1",
    "world": "world",
    "link": "estimator.drone1/controller.main",
    "radio": "main",
    "process": "estimator.drone2",
}
SOUND: dict[str, dict[str, Any]] = {
    "accel_bias": {"value_m_s2": [0.1, 0, 0]},
    "gyro_bias": {"value_deg_s": [1, 0, 0]},
    "gps_bias": {"value_m": [1, 2, 3]},
    "mag_bias": {"value_ut": [1, 2, 3]},
    "baro_bias": {"value_m": -2},
    "sonar_bias": {"value_m": 0.1},
    "flow_bias": {"value_m_s": [0.1, 0, 0]},
    **{f"{scanner}_bias": {"value_m": 0.1} for scanner in SCANNERS},
    **{kind: {"factor": 3} for kind in KINDS if kind.endswith("_noise")},
    "rotor_efficiency": {"rotor": "all", "value": 0.8},
    "rotor_stuck": {"rotor": "front_left"},
    "gust": {"velocity_m_s": [3, 0, 0], "for_s": 2},
    "link_delay": {"delay_ms": 40},
    "link_jitter": {"jitter_ms": 40},
    "link_loss": {"probability": 0.3},
    "radio": {"range_m": 30},
}


def sound(kind: str, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "target": TARGETS[KINDS[kind].strikes], **SOUND.get(kind, {}), **more}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_accepted_with_its_required_parameters(kind: str):
    assert list(flaws(sound(kind), KNOWN)) == []
    for parameter in KINDS[kind].parameters:
        left_out = {name: value for name, value in sound(kind).items() if name != parameter.name}
        paths = [path for path, _ in flaws(left_out, KNOWN)]
        assert paths == ([parameter.name] if parameter.required else [])


@pytest.mark.parametrize("kind", KINDS)
def test_faults_of_an_external_drone_are_refused(kind: str):
    known = KNOWN._replace(external=("drone1",))
    found = list(flaws(sound(kind), known))
    if KINDS[kind].strikes != "drone":
        assert found == []
    else:
        ((path, text),) = found
        assert path == "target"
        assert has_terms(text, "'drone1'", "external", "simulated", kind)


BAD = [math.nan, math.inf, "x", True, [1, 2], {}, -1e12, 10**400, [math.nan, 0, 0]]


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_is_checked(kind: str):
    for parameter, bad in product(KINDS[kind].parameters, BAD):
        if (parameter.shape == "flag" and bad is True) or (parameter.shape == "places" and bad == {}):
            continue
        ((path, text),) = flaws(sound(kind, **{parameter.name: bad}), KNOWN)
        assert path == parameter.name
        assert has_terms(text, kind)
        assert "; must be " in text


@pytest.mark.parametrize(
    ("given", "terms"),
    [
        (sound("link_loss", probability=1.4), ('probability', '1.4', '0', '1', 'link_loss')),
        (sound("gps_dropout", target="drone9"), ('target', "'drone9'", 'drone1', 'drone2', 'gps_dropout')),
        (sound("gust", target="drone1"), ('target', "'drone1'", 'world', 'gust')),
        ({"kind": "gust", "target": "world", "velocity_m_s": [1, 0, 0]}, ('for_s', 'missing', 's', 'gust')),
        (sound("process_kill", for_s=3), ('for_s', '3', 'out', 'process_kill')),
        (sound("process_kill", target="world"), ('target', "'world'", 'estimator.drone1', 'process_kill')),
        (sound("link_cut", target="drone1"), ('target', "'drone1'", 'world/estimator.drone1', 'link_cut')),
        (sound("link_cut", target="world/world"), ('target', "'world/world'", 'world/estimator.drone1', 'link_cut')),
        (sound("link_cut", target="world/estimator.drone9"), ('target', "'world/estimator.drone9'", "'estimator.drone9'", 'estimator.NAME', 'drone1', 'drone2', 'link_cut')),
        (sound("link_cut", target="console.1/gateway.main"), ('target', "'console.1/gateway.main'", 'world', 'estimator.drone1', 'link_cut')),
        (sound("radio", place={"controller.main": "drone9"}), ('place.controller.main', "'drone9'", '[x, y, z]', 'radio')),
        (sound("link_cut", target="world/controler.main"), ('target', "'world/controler.main'", "'controler.main'", 'controller.main', 'link_cut')),
        (sound("link_cut", target="wrld/controller.main"), ('target', "'wrld/controller.main'", "'wrld'", 'world', 'link_cut')),
        (sound("link_cut", target="world/recorder", one_way=True), ('target', "'world/recorder'", "'recorder'", 'estimator.drone1', 'link_cut')),
        (sound("radio", place={"controler.main": "drone1"}), ('place.controler.main', 'controller.main', 'radio')),
        (sound("radio", place={"controller.man": "drone1"}), ('place.controller.man', 'controller.NAME', 'main', 'radio')),
        (sound("radio", place={"estimator.drone9": [0, 0, 1]}), ('place.estimator.drone9', 'estimator.NAME', 'drone1', 'drone2')),
        (sound("radio", place={3: "drone1"}), ('place.3', '1', '48', '0-9', 'radio')),
        (sound("gps_dropout", at_s=-1), ('at_s', '-1', '0', '1e+06', 'gps_dropout')),
        (sound("gps_dropout", for_s=0), ('for_s', '0', '>', '0', '<=', '1e+06', 'gps_dropout')),
        (sound("gps_dropout", value=3), ('value', 'known', 'kind', 'target', 'at_s', 'for_s', 'probability', 'gps_dropout')),
        (sound("rotor_stuck", target="drone2", rotor="front_left"), ('rotor', "'front_left'", 'r1', 'r2', 'all', 'rotor_stuck')),
        (sound("rotor_stuck", rotor="left"), ('rotor', "'left'", 'front_left', 'front_right', 'rear_right', 'rear_left', 'all', 'rotor_stuck')),
    ],
)  # fmt: skip
def test_a_flaw_is_reported_with_its_parameter_value_and_limits(given: dict[str, Any], terms: tuple[str, ...]):
    (flaw,) = [f"{path} {text}" for path, text in flaws(given, KNOWN)]
    assert has_terms(flaw, *terms)


@pytest.mark.parametrize(("others", "allowed"), [((), "out"), (("lidar",), "drone2")])
@pytest.mark.parametrize("kind", [kind for kind in KINDS if KINDS[kind].sensor in SCANNERS])
def test_a_fault_of_a_sensor_that_the_drone_lacks_is_refused(kind: str, others: tuple[str, ...], allowed: str):
    sensor = KINDS[kind].sensor
    others = (sensor,) if others else ()
    ((path, text),) = flaws(sound(kind), KNOWN._replace(sensors={"drone1": (), "drone2": others}))
    assert path == "target"
    assert has_terms(text, "'drone1'", sensor, allowed, kind)
    assert list(flaws(sound(kind), KNOWN._replace(sensors={"drone1": (sensor,), "drone2": ()}))) == []


def test_an_unknown_kind_is_reported_with_a_similar_one():
    ((path, text),) = flaws({"kind": "gps_dropot"}, KNOWN)
    assert path == "kind"
    assert has_terms(text, "'gps_dropot'", "gps_dropout", f"{len(KNOWN.kinds)}", "zsim fault kinds")
    assert not has_terms(text, "imu_dropout")
    assert [path for path, _ in flaws({}, KNOWN)] == ["kind"]
    ((path, text),) = flaws([], KNOWN)
    assert path == ""
    assert has_terms(text, "[]", "map", "kind", "target")


@pytest.mark.parametrize(
    "name",
    ["my.filter", "pilot", "estimator2.drone1", "my_estimator.drone1", "controllers.main", "control.main", "contr.x"],
)
def test_a_user_s_process_name_is_accepted_before_it_has_joined(name: str):
    assert list(flaws(sound("radio", place={name: "drone1"}), KNOWN)) == []
    for target in (f"{name}/world", f"world/{name}"):
        assert list(flaws(sound("link_cut", target=target, one_way=True), KNOWN)) == []


@pytest.mark.parametrize(
    "given",
    [
        *(sound("link_cut", target=f"{a}/world", one_way=one_way) for a in ("console.1", "recorder") for one_way in (True, False)),
        *(sound("link_cut", target=target) for target in ("my.filter/controller.main", "estimator.drone1/estimator.drone2")),
        sound("process_kill", target="my.filter"),
        sound("link_cut", target="world/controler.main"),  # it looks mistyped, but such a process takes part
    ],
    ids=lambda given: given["target"],
)  # fmt: skip
def test_valid_links_and_processes_are_accepted(given: dict[str, Any]):
    assert list(flaws(given, KNOWN._replace(processes=("my.filter", "controler.main")))) == []


def test_a_kill_of_a_process_that_does_not_read_faults_is_a_flaw():
    known = Known(("drone1",), (), ("recorder",))
    ((path, text),) = flaws(sound("process_kill", target="recorder"), known)
    assert path == "target"
    assert has_terms(text, "'recorder'", "estimator.d…")


def test_times_are_rounded_to_whole_gates():
    fault = planned(sound("baro_bias", at_s=1.009, for_s=0.031), 3, "me", 0, GATE_NS)
    assert (fault.id, fault.source, fault.from_ns, fault.until_ns) == (3, "me", 50 * GATE_NS, 52 * GATE_NS)
    assert [gate for gate in range(48, 56) if acts(fault, gate * GATE_NS)] == [51, 52]
    at_once = planned(sound("baro_bias"), 1, "me", 7 * GATE_NS, GATE_NS)
    assert (at_once.from_ns, at_once.until_ns) == (7 * GATE_NS, None)
    assert acts(at_once, 10**15)
    short = planned(sound("baro_bias", for_s=0.001), 1, "me", 0, GATE_NS)
    assert short.until_ns == GATE_NS
    kill = planned(sound("process_kill", at_s=1), 1, "me", 0, GATE_NS)
    assert (kill.from_ns, kill.until_ns) == (50 * GATE_NS, 51 * GATE_NS)


def test_a_planned_fault_has_every_parameter():
    assert planned(sound("link_cut"), 1, "me", 0, GATE_NS).parameters == {"one_way": False}
    paths = planned(sound("radio", place={"controller.main": [1, 2, 3]}), 1, "me", 0, GATE_NS).parameters
    assert paths == {"range_m": 30.0, "spread_m": 5.0, "place": {"controller.main": [1.0, 2.0, 3.0]}}
    assert planned(sound("rotor_stuck"), 1, "me", 0, GATE_NS).parameters == {"rotor": "front_left", "speed_rad_s": None}


def document(*given: Any) -> dict[str, Any]:
    drones = [{"name": f"drone{k}", "position_m": [3 * k, 0, 0]} for k in (1, 2)]
    clusters = [{"name": "main", "drones": ["drone1", "drone2"]}]
    return {"name": "t", "duration_s": 1, "drones": drones, "clusters": clusters, "faults": list(given)}


def test_a_scenario_reports_every_flaw_at_once():
    with pytest.raises(ScenarioError) as paths:
        resolve(document(sound("gps_dropout"), sound("link_loss", probability=1.4), {"kind": "x"}, 3), "step.yaml")
    lines = str(paths.value).splitlines()
    assert any(has_terms(line, "step.yaml", "faults[1].probability", "1.4", "0", "1", "link_loss") for line in lines)
    assert any(has_terms(line, "step.yaml", "faults[3]", "3", "map") for line in lines)
    assert len(lines) == 3


def test_a_scenario_with_every_kind_survives_a_round_trip():
    everything = [sound(kind, at_s=1.5) for kind in KINDS]
    seeing = {"range": {}, "lidar": {}, "front_camera": {}, "depth": {}}
    scenario = resolve({**document(*everything), "sensors": seeing})
    text = scenario_file.to_text(scenario)
    assert scenario_file.from_text(text).faults == scenario.faults == everything


def test_the_table_of_kinds_in_the_documentation_matches_the_code():
    text = (Path(__file__).parents[4] / "docs/faults.md").read_text()
    table = re.search(r"<!-- kinds -->\n\n((?:\|.*\n)+)", text)
    assert table
    written = [[cell.strip() for cell in row.strip("|").split("|")] for row in table[1].splitlines()[2:]]
    assert written == [
        [f"`{name}`", kind.strikes, kind.description, "<br>".join(map(paths, kind.parameters)) or "–"]
        for name, kind in KINDS.items()
    ]


def paths(p: FaultParameter) -> str:
    standing = f"default {p.default:g}" if isinstance(p.default, float) else "may be left out"
    return f"`{p.name}` {p.description}: {expected(p)}{'' if p.required else f'; {standing}'}"
