"""Scenario files: valid ones resolve reproducibly; all faults of an invalid one are reported at once, a line each."""

import errno
import hashlib
import math
import os
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from refused import has_terms

from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.consistency import unflown_plans
from zsim.scenario.scenario import DRONES_MAX, Scenario
from zsim.scenario.scenario_file import full_path
from zsim.schema.checker import FAULTS_MAX
from zsim.schema.quantities import G_M_S2
from zsim.schema.yaml_file import FILE_SIZE_MAX
from zsim.sensors.sensor_catalogue import PRESETS

SCENARIOS = Path(__file__).parents[4] / "scenarios"
STEP = SCENARIOS / "step.yaml"
FILES = sorted(SCENARIOS.glob("**/*.yaml"))
DURATION = ("duration_s", "missing", "finite", ">", "0", "<=", "1e+06")


def assert_faults(lines: list[str], *expected: tuple[str, ...]) -> None:
    """Check that exactly the expected fields are reported, each in one line that holds the terms after it."""
    assert sorted(line.split()[1] for line in lines) == sorted(terms[0] for terms in expected)
    for terms in expected:
        assert any(has_terms(line, "step.yaml", *terms) for line in lines), terms


def drone(name: str, x: float = 0.0, **fields: Any) -> dict[str, Any]:
    return {"name": name, "position_m": [x, 0.0, 0.0], **fields}


def document(**fields: Any) -> dict[str, Any]:
    drones = [drone("drone1"), drone("drone2", 2.0), drone("drone3", 4.0)]
    return {"name": "test", "duration_s": 10, "drones": drones, **fields}


def clustered(zigzag: float = 2.0, **fields: Any) -> dict[str, Any]:
    """Return six drones in a zigzag, and a cluster of them."""
    drones = [drone(f"d{k}", 2.0 * k) for k in range(6)]
    drones = [{**d, "position_m": [*d["position_m"][:1], zigzag * (k % 2), 0.0]} for k, d in enumerate(drones)]
    return {"drones": drones, "clusters": [{"name": "c", "drones": [d["name"] for d in drones], **fields}]}


def faults_of(fields: dict[str, Any]) -> list[str]:
    with pytest.raises(ScenarioError) as caught:
        scenario_file.resolve(fields, "step.yaml")
    assert_lines(caught.value.faults)
    assert str(caught.value) == "\n".join(caught.value.faults)
    return caught.value.faults


def faults_in(path: Path | str, *overrides: str, **values: Any) -> list[str]:
    with pytest.raises(ScenarioError) as caught:
        scenario_file.load(path, overrides, **values)
    assert_lines(caught.value.faults)
    return caught.value.faults


def faults_of_text(tmp_path: Path, text: str | bytes) -> list[str]:
    path = tmp_path / "own.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return faults_in(path)


def assert_lines(lines: list[str]) -> None:
    assert lines
    for line in lines:
        assert line.isprintable(), line
        assert len(line) < 500, line


def only(lines: list[str]) -> str:
    (line,) = lines
    return line


# The shipped scenarios


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_resolved_text_gives_the_same_scenario(path: Path):
    scenario = scenario_file.load(path)
    text = scenario_file.to_text(scenario)
    again = scenario_file.from_text(text)
    assert again == scenario
    assert scenario_file.to_text(again) == text
    assert yaml.safe_load(text)["drones"][0]["mass_kg"] == scenario.drones[0].mass_kg
    assert scenario_file.sha256(text) == hashlib.sha256(text.encode()).hexdigest()


# Resolving


def test_defaults_are_the_ardrone_in_buenos_aires():
    scenario = scenario_file.resolve(document())
    assert scenario.drone("drone2").mass_kg == 0.429
    assert scenario.drone("drone2").sensors.preset == "ardrone2"
    assert scenario.environment.latitude_deg == -34.603
    assert scenario.time.gate_ms == 20.0
    assert scenario.federation == "zsim"


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_a_preset_sets_all_its_values(preset: str):
    sensors = scenario_file.resolve(document(sensors={"preset": preset})).drones[0].sensors
    plain = msgspec.to_builtins(sensors)
    for sensor, figures in PRESETS[preset].items():
        for name, value in figures.items():
            found = plain[sensor][name]
            assert found == ({**found, **value} if isinstance(value, dict) else value)


def test_drone_sensors_override_scenario_sensors_which_override_the_preset():
    drones = [drone("a"), drone("b", 2.0, sensors={"gps": {"position_m": {"noise": 0.5}}})]
    shared = {"preset": "paper", "gps": {"position_m": {"noise": 1.0, "bias": 0.1}}}
    first, second = scenario_file.resolve(document(drones=drones, sensors=shared)).drones
    assert (first.sensors.gps.position_m.noise, first.sensors.gps.position_m.bias) == (1.0, 0.1)
    assert (second.sensors.gps.position_m.noise, second.sensors.gps.position_m.bias) == (0.5, 0.1)
    assert second.sensors.gps.rate_hz == 5.0
    assert second.sensors.imu.accel_m_s2.noise == 0.35
    drones[0]["sensors"], drones[1]["sensors"] = {"as_printed": True}, {"preset": "ardrone2"}
    first, second = scenario_file.resolve(document(drones=drones, sensors={"preset": "paper"})).drones
    assert (first.sensors.preset, second.sensors.preset) == ("paper", "ardrone2")
    assert (first.sensors.imu.accel_m_s2.noise, first.sensors.imu.gyro_deg_s.noise) == (0.35 * G_M_S2, 0.01)
    assert second.sensors.imu.accel_m_s2.noise == PRESETS["ardrone2"]["imu"]["accel_m_s2"]["noise"]


def test_resolving_does_not_change_the_document():
    raw = document(sensors={"preset": "paper"})
    before = msgspec.json.encode(raw)
    scenario_file.resolve(raw)
    assert msgspec.json.encode(raw) == before


def named(scenario: Scenario) -> str:
    return scenario_file.sha256(scenario_file.to_text(scenario))


def test_a_drone_is_external_only_if_declared_and_takes_no_faults():
    plain = scenario_file.resolve(document())
    assert ("body" in scenario_file.to_text(plain), plain.external()) == (False, [])
    fault = {"kind": "gps_noise", "target": "b", "factor": 2.0}
    drones = [drone("a"), drone("b", x=5.0, body="external")]
    assert_faults(faults_of(document(drones=drones, faults=[fault])), ("faults[0].target", "'b'", "external"))
    external = scenario_file.resolve(document(drones=drones, faults=[{**fault, "target": "a"}]))
    assert external.external() == ["b"]
    assert scenario_file.from_text(scenario_file.to_text(external)) == external


@pytest.mark.parametrize(
    ("override", "is_other"),
    [
        ("seed=2", True),
        ("wind.gust_correlation=0.4999999999999999", True),
        ("seed=1", False),
        ("duration_s=330.0", False),
    ],
)
def test_only_a_changed_value_changes_the_hash(override: str, is_other: bool):
    assert (named(scenario_file.load(STEP, [override])) != named(scenario_file.load(STEP))) == is_other


LIKE_OTHERS = ["1e3", "1e-3", "1.5", "010", "0x1F", "1_000", "1:30", "yes", "null", "~", "#", "nan", ".inf"]
texts = st.text(st.characters(codec="utf-8"), max_size=30) | st.sampled_from([*LIKE_OTHERS, "", " ", "- a", "a: b"])


@settings(max_examples=20, deadline=None)
@given(
    expressions=st.dictionaries(texts, texts, min_size=1, max_size=3),
    numbers=st.lists(st.floats(-1e9, 1e9), min_size=4, max_size=4),
)
def test_any_text_and_number_survive_a_round_trip(expressions: dict[str, str], numbers: list[float]):
    """Texts that look like numbers stay texts; numbers keep their last bit."""
    plan = {"trajectory": {"expressions": expressions, "constants": {"f": numbers[0]}}}
    wind = {"steady_m_s": numbers[1:]}
    clusters = [{"name": "main", "drones": ["drone1", "drone2"], "plan": plan}]
    scenario = scenario_file.resolve(document(clusters=clusters, environment={"wind": wind}))
    again = scenario_file.from_text(scenario_file.to_text(scenario))
    assert again == scenario
    assert [x.hex() for x in again.environment.wind.steady_m_s] == [float(x).hex() for x in numbers[1:]]


def test_a_file_with_a_byte_order_mark_is_read(tmp_path: Path):
    path = tmp_path / "own.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + STEP.read_bytes())
    assert scenario_file.load(path) == scenario_file.load(STEP)


def test_keyword_values_override_the_file_unless_none():
    scenario = scenario_file.load(STEP, seed=7, duration_s=None, federation="other")
    assert (scenario.seed, scenario.duration_s, scenario.federation) == (7, 330.0, "other")


# Overrides


@pytest.mark.parametrize(
    "path",
    ["drones.drone2.mass_kg", "drones.1.mass_kg", "drones[1].mass_kg", "drones[drone2].mass_kg", "drones[1][mass_kg]"],
)
def test_a_list_entry_is_addressed_by_index_or_name(path: str):
    scenario = scenario_file.load(STEP, [f"{path}=0.5"])
    assert [d.mass_kg for d in scenario.drones] == [0.429, 0.5, 0.429]


def test_an_override_creates_a_missing_section():
    scenario = scenario_file.load(STEP, ["drones.drone1.limits.tilt_deg=10", "silence.hover_s=1.5"])
    assert scenario.drone("drone1").limits.tilt_deg == 10.0
    assert scenario.silence.hover_s == 1.5


def test_an_empty_section_counts_as_missing(tmp_path: Path):
    path = tmp_path / "own.yaml"
    path.write_text("name: own\nduration_s: 1\nsilence:\ndrones: [{name: a, position_m: [0, 0, 0]}]\n")
    assert scenario_file.load(path, ["silence.hover_s=1.5"]).silence.hover_s == 1.5


def test_overrides_apply_in_order():
    overrides = ["drones.drone1.name=lead", "drones.lead.yaw_deg=45", "clusters.main.drones=[lead, drone2, drone3]"]
    scenario = scenario_file.load(STEP, [*overrides, "seed=2", "seed=3"])
    assert scenario.drone("lead").yaw_deg == 45.0
    assert scenario.seed == 3


@pytest.mark.parametrize(
    ("path", "whole"),
    [
        ("wind.gust_m_s", "environment.wind.gust_m_s"),
        ("wind[gust_m_s]", "environment.wind[gust_m_s]"),
        ("gate_ms", "time.gate_ms"),
        ("imu.rate_hz", "sensors.imu.rate_hz"),
        ("drones[0].mass_kg", "drones[0].mass_kg"),
        ("environment.wind.gust_m_s", "environment.wind.gust_m_s"),
        ("nothing.here", "nothing.here"),
    ],
)
def test_section_names_may_be_omitted(path: str, whole: str):
    assert full_path(path) == whole


@pytest.mark.parametrize(
    ("path", "entries", "whole"),
    [
        ("gains.proportional_1_s", ["main"], "clusters.main.gains.proportional_1_s"),
        ("plan.takeoff_s", ["a.b"], "clusters[0].plan.takeoff_s"),
        ("gains.proportional_1_s", [], "gains.proportional_1_s"),
        ("seeds", ["main"], "seeds"),
    ],
)
def test_the_only_entry_of_a_list_need_not_be_named(path: str, entries: list[str], whole: str) -> None:
    assert full_path(path, {"clusters": [{"name": name} for name in entries]}) == whole


def test_a_field_of_several_entries_is_refused_with_an_example_path() -> None:
    with pytest.raises(ValueError, match=r"2 clusters.*clusters\.left\.gains\.proportional_1_s"):
        full_path("gains.proportional_1_s", {"clusters": [{"name": "left"}, {"name": "right"}]})
    assert scenario_file.load(STEP, ["gains.proportional_1_s=0.4"]).clusters[0].gains.proportional_1_s == 0.4


@pytest.mark.parametrize(
    ("override", "meant"),
    [
        ("seeds=3", "seed"),
        ("wind.gust=1", "gust_m_s"),
        ("drones.drone11.mass_kg=1", "drone1"),
        ("gains.proportional=0.4", "proportional_1_s"),
        ("sensors.gpss={rate_hz: 5}", "gps"),
        ("faults=[{kind: gps_dropout, target: drone1, fro_s: 3}]", "for_s"),
    ],
)
def test_an_unknown_name_is_reported_with_a_similar_one(override: str, meant: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        scenario_file.load(STEP, [override])
    assert any(has_terms(line, "mean", meant, "allowed") for line in caught.value.faults)


def test_override_values_are_yaml():
    overrides = [
        "drones.drone1.position_m=[0, 9.5, 0]",
        "report={window_s: [1, 2]}",
        "clusters.main.plan.takeoff_s=null",
    ]
    scenario = scenario_file.load(STEP, overrides)
    assert scenario.drone("drone1").position_m == (0.0, 9.5, 0.0)
    assert scenario.report.window_s == (1.0, 2.0)
    assert scenario.cluster("main").plan.takeoff_s is None


def test_a_drone_whose_name_is_a_number_or_has_dots_is_found():
    drones = [drone("2"), drone("1", 2.0)]
    for name, path in (("0", "drones.0.mass_kg"), ("uav.2", "drones[uav.2].mass_kg")):
        raw = document(drones=[*drones[:2], drone(name, 4.0)])
        assert scenario_file.apply_override(raw, f"{path}=0.5", yaml.safe_load) is None
        assert raw["drones"][2]["mass_kg"] == 0.5


SYNTAX = ("a.b.c=value",)


@pytest.mark.parametrize(
    ("override", "terms"),
    [
        ("", SYNTAX),
        ("seed", SYNTAX),
        ("a..b=1", SYNTAX),
        (".a=1", SYNTAX),
        ("a[0=1", SYNTAX),
        ("a[]=1", SYNTAX),
        ("drones.9.mass_kg=1", ("9", "0", "2", "drone1", "drone2", "drone3")),
        ("drones.-1.mass_kg=1", ("-1", "0", "2", "drone1", "drone2", "drone3")),
        ("drones.drone9=1", ("drone9", "0", "2", "drone1", "drone2", "drone3")),
        ("drones.²=1", ("²", "not", "drones")),
        (f"drones.{'9' * 900}=1", ("not", "drones", "drone1")),
        (f"drones.{'9' * 5000}=1", ("5007", "1000")),
        ("clusters.main.drones.7=drone1", ("7", "clusters.main.drones", "0", "2")),
        ("seed.x=1", ("seed", "1", "map", "list")),
        ("seed.x.y=1", ("seed", "1", "map", "list")),
        ("seed=[1", ("line 1", "YAML")),
        ("seed=&a [*a]", ("aliases",)),
        ("seed=" + "9" * 5000, ("YAML",)),
        ("seed=" + "[" * 1500, ("'seed=[[[…", "nested")),
        ("seed=!!python/name:os.system", ("YAML",)),
    ],
    ids=lambda text: text[:24],
)
def test_an_invalid_override_is_reported(override: str, terms: tuple[str, ...]):
    line = only(faults_in(STEP, override))
    assert line.startswith("--set ")
    assert has_terms(line, *terms)


@pytest.mark.parametrize(
    ("override", "terms"),
    [
        ("sede=2", ("step.yaml", "sede", "known", "clusters", "drones")),
        ("environment.wind.gust=2", ("step.yaml", "environment.wind.gust", "known", "gust_correlation")),
        ("seed=", ("step.yaml", "seed", "null", "whole", ">=", "0", "<=", "4611686018427387904")),
        ("seed=1.5", ("step.yaml", "seed", "1.5", "whole", ">=", "0")),
        ("duration_s=.nan", ("step.yaml", "duration_s", "nan", "finite", ">", "0", "<=", "1e+06")),
        ("drones.drone1=5", ("step.yaml", "drones[0]", "5", "map")),
    ],
)
def test_a_fault_caused_by_an_override_is_reported_as_one_of_the_file(override: str, terms: tuple[str, ...]):
    assert has_terms(faults_in(STEP, override)[0], *terms)


def test_faults_of_overrides_and_of_the_file_are_reported_together():
    lines = faults_in(STEP, "seed", "drones.9.mass_kg=1", "drones.drone3.mass_kg=-1.4", seed=-1)
    assert len(lines) == 4
    assert [line.split(":")[0] for line in lines] == ["--set seed", "--set drones.9.mass_kg=1"] + ["step.yaml"] * 2


@settings(max_examples=100, deadline=None)
@given(text=st.text(max_size=30) | st.from_regex(r"[a-d.\[\]0-9]{1,12}=[\[\]{}a*&!1:,-]{0,8}", fullmatch=True))
def test_any_override_is_applied_or_refused(text: str):
    try:
        scenario_file.load(STEP, [text])
    except ScenarioError as error:
        assert_lines(error.faults)


# Faults of one field


def test_a_cluster_fault_has_path_value_limits_and_cluster_name():
    line = only(faults_in(STEP, "clusters.main.gains.proportional_1_s=3"))
    said = "clusters[0].gains.proportional_1_s is 3; must be > 0 and <= 2 (cluster 'main')"
    assert line == f"step.yaml: {said}"


@pytest.mark.parametrize(
    ("path", "value", "allowed"),
    [
        ("duration_s", "0", "> 0 and <= 1e+06"),
        ("drones.drone1.mass_kg", "9" * 4000, "must be"),
        ("sensors.imu.rate_hz", ".nan", "finite"),
        ("clusters.main.plan.takeoff_s", "-.inf", "finite"),
        ("drones.drone1.position_m", "[1e300, 0, 0]", ">= -100000 and <= 100000"),
        ("drones.drone1.battery_percent", "101", ">= 0 and <= 100"),
        ("environment.wind.gust_correlation", "1.5", ">= 0 and <= 1"),
        ("seed", str(2**62 + 1), "<= 4611686018427387904"),
        ("time.command_delay_gates", "0", ">= 1 and <= 50"),
    ],
)
def test_limits_are_quoted(path: str, value: str, allowed: str):
    assert allowed in only(faults_in(STEP, f"{path}={value}"))


@pytest.mark.parametrize("value", ["Step", "a/b", "x" * 33, '"a\\n"', "''"])
def test_names_must_match_the_contract(value: str):
    for field in ("name", "federation"):
        assert has_terms(only(faults_in(STEP, f"{field}={value}")), field, "[a-z0-9_.-]{1,32}")


@pytest.mark.parametrize(
    ("fields", "terms"),
    [
        ({"drones": []}, ("step.yaml", "drones", "0", "1", "1000")),
        ({"drones": None}, ("step.yaml", "drones", "null", "list")),
        ({"drones": {"a": 1}}, ("step.yaml", "drones", "{'a': 1}", "list")),
        ({"drones": [drone("a", i) for i in range(DRONES_MAX + 1)]}, ("drones", "1001", "1", "1000")),
        ({"drones": [7]}, ("step.yaml", "drones[0]", "7", "map")),
        ({"clusters": 5}, ("step.yaml", "clusters", "5", "list")),
        ({"sensors": 5}, ("step.yaml", "sensors", "5", "map")),
        ({"sensors": {"preset": "best"}}, ("step.yaml", "sensors.preset", "'best'", "ardrone2", "paper")),
        ({"sensors": {"preset": ["paper"]}}, ("step.yaml", "sensors.preset", "['paper']", "ardrone2", "paper")),
        ({"sensors": {"radar": {}}}, ("step.yaml", "sensors.radar", "known", "as_printed", "baro")),
        ({"sensors": {"imu": 3}}, ("step.yaml", "sensors.imu", "3", "map")),
        ({"drones": [drone("a", sensors=3)]}, ("step.yaml", "drones[0].sensors", "3", "map", "'a'")),
        ({"drones": [drone("a", position_m=[1, 2])]}, ("drones[0].position_m", "[1, 2]", "list", "3")),
        ({"drones": [{"name": "a"}]}, ("drones[0].position_m", "missing", "list", "3", "'a'")),
        ({"drones": [drone("a", model="x")]}, ("drones[0].model", "'x'", "ardrone2")),
        ({"processes": {"on_death": {"world": "weep"}}}, ("drop", "end", "restart", "wait")),
        ({"processes": {"on_death": {"world": "wait"}}}, ("processes.on_death.world", "'wait'", "restart", "end")),
        ({"processes": {"on_death": {"world": "drop"}}}, ("processes.on_death.world", "'drop'", "restart", "end")),
        ({7: 1}, ("step.yaml", "7", "known", "clusters")),
    ],
)
def test_a_wrong_structure_is_reported(fields: dict[Any, Any], terms: tuple[str, ...]):
    assert has_terms(only(faults_of(document(clusters=[]) | fields)), *terms)


def test_an_empty_scenario_reports_every_missing_field():
    assert_faults(faults_of({}), ("name", "missing", "text"), DURATION, ("drones", "missing", "list"))


def test_a_fault_shared_by_all_drones_is_reported_once():
    line = only(faults_of(document(sensors={"imu": {"rate_hz": -5}})))
    assert has_terms(line, "step.yaml", "sensors.imu.rate_hz", "-5", ">=", "0.01", "<=", "1000")


# Faults between fields


@pytest.mark.parametrize(
    ("fields", "terms"),
    [
        ({"drones": [drone("a"), drone("b", 2.0), drone("a", 4.0)]}, ("drones[2].name", "'a'", "drones[0]", "unique")),
        ({"drones": [drone("a"), drone("b", 0.5)]}, ("drones[1].position_m", "0.50", "'a'", ">=", "0.6", "'b'")),
        ({"drones": [drone("a", position_m=[0, 0, -1])]}, ("drones[0].position_m[2]", "-1", ">=", "0")),
        ({"drones": [drone("a", mass_kg=2)]}, ("drones[0].mass_kg", "2", "<", "0.747")),
        ({"drones": [drone("a", rotor_min_rad_s=600)]}, ("drones[0].rotor_min_rad_s", "600", "<", "rotor_max_rad_s", "503")),
        ({"drones": [drone("a", rotor_min_rad_s=400)]}, ("drones[0].rotor_min_rad_s", "400", "<", "361.5", "hover")),
        ({"drones": [drone("a", torque_nm_s2=0.016)]}, ("drones[0].torque_nm_s2", "0.016", "3.36e+06 W", "1.29", "4.29e+03 W", "thrust_n_s2")),  # torque per thrust in metres, as in RotorS
        ({"drones": [drone("a", torque_nm_s2=1e-15)]}, ("drones[0].torque_nm_s2", "1e-15", "W", "N m s^2")),
        ({"drones": [drone("a", inertia_kg_m2=[2, 2, 4])]}, ("drones[0].inertia_kg_m2", "[2, 2, 4]", "0.137", "kg m^2")),
        ({"drones": [drone("a", thrust_n_s2=0.01)]}, ("drones[0].thrust_n_s2", "0.01", "0.042 %", "0.5", "90 %", "N s^2")),  # per (rev/s)^2 instead of (rad/s)^2, and larger still
        ({"drones": [drone("a", rotor_max_rad_s=4803)]}, ("drones[0].rotor_max_rad_s", "4803", "480 m/s", "3403", "sound", "rad/s", "rpm")),  # given in revolutions per minute
        ({"drones": [drone("a", model="crazyflie2", rotor_max_rad_s=21706)]}, ("drones[0].rotor_max_rad_s", "21706", "501 m/s", "14732")),
        ({"drones": [drone("a", drag_n_s_m=24.9)]}, ("drones[0].drag_n_s_m", "24.9", "2 m/s", "49.8 N", "4.21 N", "2.1", "N s/m")),  # a hundred times the AR.Drone's
        ({"drones": [drone("a", aerodynamics={"quadratic_drag_n_s2_m2": [0.1, 0.1, 5]})]}, ("drones[0].aerodynamics.quadratic_drag_n_s2_m2", "[0.1, 0.1, 5]", "20 N", "1.05", "N s^2/m^2")),
        (
            {"drones": [drone("a", aerodynamics={"rotor_drag_n_s2_m": 0.0119})]},  # instead of 1.19e-4
            ("drones[0].aerodynamics.rotor_drag_n_s2_m", "0.0119", "N s^2/m"),
        ),
        ({"drones": [drone("a", battery_mah=1)]}, ("drones[0].battery_mah", "0.72 s", "10", "86400 s", "mAh")),  # given in ampere-hours
        ({"drones": [drone("a", battery_mah=1e6)]}, ("drones[0].battery_mah", "7.2e+05 s", "86400 s")),
        ({"drones": [drone("a", limits={"tilt_deg": 58})]}, ("drones[0].limits.tilt_deg", "58", "<=", "55.0", "weight")),
        ({"drones": [drone("a", mass_kg=0.72, limits={"tilt_deg": 45})]}, ("drones[0].limits.tilt_deg", "45", "<=", "30.0", "weight")),  # its rotors carry its weight up to 15.4 deg, but 30 deg are allowed for every drone
        ({"sensors": {"imu": {"rate_hz": 500}}, "drones": [drone("a")]}, ("drones[0].sensors.imu.rate_hz", "500", "<=", "200")),
        ({"sensors": {"sonar": {"min_m": 7}}, "drones": [drone("a")]}, ("drones[0].sensors.sonar.min_m", "7", "<", "max_m", "6")),
        ({"sensors": {"as_printed": True}, "drones": [drone("a")]}, ("drones[0].sensors.as_printed", "true", "false")),
        ({"environment": {"height_m": 10_500}, "drones": [drone("a", position_m=[0, 0, 600])]}, ("drones[0].position_m[2]", "600", "environment.height_m", "10500", "<=", "11000")),
        ({"environment": {"height_m": 10_500}, "drones": [drone("a", limits={"altitude_m": 501})]}, ("drones[0].limits.altitude_m", "501", "environment.height_m", "10500")),
        ({"time": {"gate_ms": 7}}, ("time.gate_ms", "7", "5")),
        ({"time": {"physics_dt_ms": 3}}, ("time.physics_dt_ms", "3", "5")),
        ({"time": {"physics_dt_ms": 1e-9}}, ("time.physics_dt_ms", "1e-09", "5")),
        ({"report": {"window_s": [5, 5]}}, ("report.window_s", "[5, 5]", "[start, end]", "0", "<=", "<")),
        ({"report": {"window_s": [-1, 5]}}, ("report.window_s", "[-1, 5]")),
        ({"processes": {"expect": ["a", "b", "a"]}}, ("processes.expect[2]", "'a'", "expect[0]", "unique")),
        ({"processes": {"expect": ["my.drone1", "estimator.ghost"]}}, ("processes.expect[1]", "'estimator.ghost'", "'ghost'", "estimator.NAME", "drone1")),
        ({"processes": {"expect": ["controller.ghost"]}, "clusters": []}, ("processes.expect[0]", "'controller.ghost'", "'ghost'", "controller.NAME")),
        ({"clusters": [{"name": "c", "drones": ["drone1", "drone9"]}]}, ("clusters[0].drones[1]", "'drone9'")),
        ({"clusters": [{"name": "c", "drones": ["drone1", "drone1"]}]}, ("clusters[0].drones[1]", "'drone1'", "'c'")),
        ({"clusters": [{"name": "c", "drones": ["drone1", "drone2"]}, {"name": "d", "drones": ["drone2", "drone3"]}]}, ("clusters[1].drones[0]", "'drone2'", "'c'")),
        ({"drones": [drone(f"d{k}", 2.0 * k) for k in range(4)], "clusters": [{"name": "c", "drones": ["d0", "d1"]}, {"name": "c", "drones": ["d2", "d3"]}]}, ("clusters[1].name", "'c'", "clusters[0]", "unique")),
        ({"clusters": [{"name": "c", "drones": ["drone1", "drone2"], "plan": {"trajectory": {}}}]}, ("expressions", "waypoints", "'c'")),
        ({"clusters": [{"name": "c", "drones": ["drone1", "drone2"], "plan": {"trajectory": {"expressions": {"x_c": "t"}, "waypoints": [{"at_s": 0, "values": {"x_c": 1}}]}}}]}, ("expressions", "waypoints")),
        (clustered(groups=[{"name": "a", "size": 6}]), ("clusters[0].groups", "1", "none", "2")),
        (clustered(groups=[{"name": "a", "size": 2}, {"name": "b", "size": 3}]), ("clusters[0].groups", "5", "6")),
        (clustered(groups=[{"name": "a", "size": 3}, {"name": "a", "size": 3}]), ("clusters[0].groups[1].name", "'a'", "groups[0]", "unique")),
        (clustered(groups=[{"name": "a", "size": 4}, {"name": "b", "size": 2, "space": "template"}]), ("clusters[0].groups[1].space", "2", "3")),
        (clustered(groups=[{"name": "a", "size": 4}, {"name": "b", "size": 2}], template_m=[[0, 0, 0], [1, 0, 0]]), ("clusters[0].template_m", "2", "3")),
        (clustered(space="triad", template_m=[[0, 0, 0]]), ("clusters[0].template_m", "given")),
        (clustered(template_m=[[0, 0, 0]]), ("clusters[0].template_m", "1", "6")),
        (clustered(template_m=[[k, k, 0] for k in range(6)]), ("clusters[0].template_m", "0.1")),
        (clustered(zigzag=0.0), ("clusters[0].template_m", "missing", "given")),
        (clustered(space="ring"), ("clusters[0].space", "'ring'", "triad", "template", "package.module:Class", "'c'")),
    ],
)  # fmt: skip
def test_inconsistent_fields_are_reported(fields: dict[str, Any], terms: tuple[str, ...]):
    assert has_terms(only(faults_of(document(**fields))), *terms)


def test_group_faults_are_reported_together_except_between_faulty_fields():
    groups = [{"name": "a", "size": 1}, {"name": "b", "size": 4, "template_m": [[0, 0]] * 4}, {"name": "b", "size": 3}]
    assert_faults(
        faults_of(document(**clustered(groups=groups))),
        ("clusters[0].groups[0].size", "1"),
        *((f"clusters[0].groups[1].template_m[{place}]", "[0, 0]") for place in range(4)),
        ("clusters[0].groups[2].name", "'b'", "groups[1]"),
    )


def test_waypoints_must_go_forward_in_time():
    waypoints = [{"at_s": at, "values": {"x_c": 1}} for at in (0, 5, 5, 4, 9)]
    clusters = [{"name": "c", "drones": ["drone1", "drone2"], "plan": {"trajectory": {"waypoints": waypoints}}}]
    lines = faults_of(document(clusters=clusters))
    assert len(lines) == 2
    assert has_terms(lines[0], "clusters[0].plan.trajectory.waypoints[2].at_s", "5", ">", "5")
    assert has_terms(lines[1], "clusters[0].plan.trajectory.waypoints[3].at_s", "4", ">", "5")


def test_faults_in_and_between_fields_are_reported_together():
    """Only checks whose own fields are faulty are left out."""
    drones = [
        drone("a", yaw_deg=math.inf),
        drone("a", 2.0, mass_kg=-1.4),
        drone("b", 2.1, rotor_min_rad_s=900),
        {"name": "C", "position_m": ["x", 0, 0]},
        drone("d", 9.0, mass_kg=50),
        5,
    ]
    clusters = [{"name": "main", "drones": ["a", "zz"], "plan": {"takeoff_s": "x", "trajectory": {}}}]
    time_s = {"gate_ms": 7, "command_delay_gates": 0}
    raw = document(seed=1.5, colour="red", drones=drones, clusters=clusters, time=time_s, report={"window_s": [2, 1]})
    assert_faults(
        faults_of(raw),
        ("colour", "known"),
        ("seed", "1.5"),
        ("time.command_delay_gates", "0"),
        ("drones[0].yaw_deg", "inf"),
        ("drones[1].mass_kg", "-1.4"),
        ("drones[3].name", "'C'"),
        ("drones[3].position_m[0]", "'x'"),
        ("drones[5]", "5"),
        ("clusters[0].plan.takeoff_s", "'x'"),
        ("drones[1].name", "'a'", "drones[0]"),
        ("time.gate_ms", "7"),
        ("drones[2].position_m", "0.10", "'a'"),
        ("drones[2].rotor_min_rad_s", "900"),
        ("drones[4].mass_kg", "50"),
        ("clusters[0].plan.trajectory", "expressions", "waypoints"),
        ("report.window_s", "[2, 1]"),
    )


def test_cluster_drones_are_not_checked_while_a_drone_has_no_name():
    clusters = [{"name": "c", "drones": ["drone1", "drone9"]}]
    lines = faults_of(document(drones=[drone("drone1"), {"position_m": [2, 0, 0]}], clusters=clusters))
    assert has_terms(only(lines), "step.yaml", "drones[1].name", "missing")


# Files that are not scenarios


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("", ("empty", "map")),
        ("just words", ("'just words'", "map")),
        ("- 1\n- 2\n", ("[1, 2]", "map")),
        ("a: 1\nb: 2\na: 3\n", ("line 3", "YAML", "'a'", "twice")),
        ("a: 1\n---\nb: 2\n", ("YAML",)),
        ("a: &x [1]\nb: *x\n", ("line 2", "YAML", "aliases")),
        ("a: &a [x]\n" + "".join(f"b{i}: &b{i} [*a, *a]\n" for i in range(20)), ("aliases",)),
        ("[" * 500_000, ("nested",)),
        ("a: " + "9" * 900_000, ("YAML",)),
        ("a: !!python/object/apply:os.system [ls]", ("line 1", "YAML", "tags")),
        ("? [1, 2]\n: 3", ("line 1", "YAML")),
        ("a: \x07", ("YAML",)),
        (b"\xff\xfe\x00", ("text", "0", "YAML", "UTF-8")),
        ("#" * (FILE_SIZE_MAX + 1), ("larger", str(FILE_SIZE_MAX))),
    ],
    ids=lambda text: repr(text[:12]),
)
def test_a_file_that_is_not_a_scenario_is_reported_in_one_line(
    tmp_path: Path, text: str | bytes, terms: tuple[str, ...]
):
    line = only(faults_of_text(tmp_path, text))
    assert "own.yaml" in line
    assert has_terms(line, *terms)


def test_an_unreadable_path_is_reported_in_one_line(tmp_path: Path):
    assert has_terms(only(faults_in(tmp_path / "none.yaml")), "read", os.strerror(errno.ENOENT))
    assert has_terms(only(faults_in(tmp_path)), "read", os.strerror(errno.EISDIR))
    assert has_terms(only(faults_in("a\0b")), "path")
    assert has_terms(only(faults_in("/dev/zero")), "larger", str(FILE_SIZE_MAX))


def test_a_million_drones_are_refused_quickly():
    start_s = time.process_time()
    raw = document(drones=[drone("a")] * 1_000_000)
    assert has_terms(only(faults_of(raw)), "step.yaml", "drones", "1000000", "1", "1000")
    assert time.process_time() - start_s < 2.0


def test_the_number_of_reported_faults_is_limited():
    lines = faults_of(document(**{f"k{i}": i for i in range(5000)}))
    assert len(lines) == FAULTS_MAX + 1
    assert has_terms(lines[-1], "4900")


def test_a_thousand_drones_are_accepted():
    drones = [drone(f"d{i}", position_m=[2 * (i % 32), 2 * (i // 32), 0]) for i in range(DRONES_MAX)]
    assert len(scenario_file.resolve(document(drones=drones)).drones) == DRONES_MAX


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.dates() | st.binary(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5) | st.integers(), inner, max_size=3),
    max_leaves=5,
)
places = st.lists(
    st.sampled_from([*Scenario.__struct_fields__, "sensors", "name", "position_m", "imu", "plan", "drones", 0, 1]),
    min_size=1,
    max_size=4,
)


@example(changes=[(["sensors"], {"\U000101fe": None, 7: {"module": "x"}})])
@settings(max_examples=100, deadline=None)
@given(changes=st.lists(st.tuples(places, values), min_size=1, max_size=3))
def test_any_document_resolves_or_is_refused(changes: list[tuple[list[Any], Any]]):
    clusters = [{"name": "c", "drones": ["drone1", "drone2"], "plan": {"takeoff_s": 1}}]
    raw: Any = document(clusters=clusters, sensors={"preset": "paper"})
    for path, value in changes:
        place = raw
        for step in path[:-1]:
            inside = place[step] if isinstance(place, dict) and step in place else None
            if isinstance(place, list) and isinstance(step, int) and step < len(place):
                inside = place[step]
            place = inside if isinstance(inside, dict | list) else place
        if isinstance(place, dict):
            place[path[-1]] = value
    try:
        scenario = scenario_file.resolve(raw)
    except ScenarioError as error:
        assert_lines(error.faults)
    else:
        assert scenario_file.from_text(scenario_file.to_text(scenario)) == scenario


# The shared vehicle


def test_a_shared_vehicle_equals_the_same_fields_in_every_drone():
    file = SCENARIOS / "crazyflie.yaml"
    written = yaml.safe_load(file.read_text())
    drones = [{name: value for name, value in each.items() if name != "model"} for each in written["drones"]]
    shared = {**written, "vehicle": {"model": "crazyflie2"}, "drones": drones}
    assert scenario_file.to_text(scenario_file.resolve(shared)) == scenario_file.to_text(scenario_file.load(file))


def test_a_drone_s_own_field_overrides_the_shared_vehicle():
    scenario = scenario_file.load(STEP, ["vehicle.mass_kg=0.5"])
    assert [each.mass_kg for each in scenario.drones] == [0.5] * 3
    vehicle = {"mass_kg": 0.5, "battery_mah": 1500, "limits": {"tilt_deg": 12, "altitude_m": 30}}
    drones = [drone("a"), drone("b", 2.0, mass_kg=0.48, limits={"tilt_deg": 9})]
    a, b = scenario_file.resolve(document(drones=drones, vehicle=vehicle)).drones
    assert [(each.mass_kg, each.battery_mah) for each in (a, b)] == [(0.5, 1500), (0.48, 1500)]
    assert [(each.limits.tilt_deg, each.limits.altitude_m) for each in (a, b)] == [(12, 30), (9, 30)]


def test_aerodynamics_merge_field_by_field_and_are_omitted_if_absent():
    vehicle = {"aerodynamics": {"rotor_drag_n_s2_m": 1e-4, "rotor_lift_n_s2_m2": 1e-3}}
    drones = [drone("a"), drone("b", 2.0, aerodynamics={"rotor_drag_n_s2_m": 2e-4}), drone("c", 4.0, model="iris")]
    a, b, c = scenario_file.resolve(document(drones=drones, vehicle=vehicle)).drones
    coefficients = [(x.aerodynamics.rotor_drag_n_s2_m, x.aerodynamics.rotor_lift_n_s2_m2) for x in (a, b, c)]  # type: ignore[union-attr]
    assert coefficients == [(1e-4, 1e-3), (2e-4, 1e-3), (1e-4, 1e-3)]
    (iris,) = scenario_file.resolve(document(drones=[drone("c", model="iris")])).drones
    assert iris.aerodynamics.rotor_drag_n_s2_m == 8.06428e-5  # type: ignore[union-attr]
    assert "aerodynamics" not in scenario_file.to_text(scenario_file.resolve(document(drones=[drone("a")])))


@pytest.mark.parametrize(
    ("vehicle", "path"),
    [
        ({"mass_kg": -1}, "vehicle.mass_kg"),
        ({"limits": {"tilt_deg": 99}}, "vehicle.limits.tilt_deg"),
        ({"inertia_kg_m2": [1, 2, -3]}, "vehicle.inertia_kg_m2[2]"),
        ({"name": "x"}, "vehicle.name"),
        ([1], "vehicle"),
    ],
)
def test_a_fault_of_the_shared_vehicle_is_reported_once_with_its_path(vehicle: Any, path: str):
    with pytest.raises(ScenarioError) as raised:
        scenario_file.resolve(document(vehicle=vehicle))
    assert [line.split()[1] for line in raised.value.faults] == [path]


@pytest.mark.parametrize(
    ("plan", "duration_s", "terms"),
    [
        ({"takeoff_s": 20}, 20, ("clusters[0].plan", "20 s", "take-off at 20 s", "none", "'c'")),
        ({"takeoff_s": 20, "land_s": 90}, 5, ("5 s", "take-off at 20 s and its landing at 90 s", "none")),
        ({"land_s": 90}, 50, ("landing at 90 s", "none")),
        ({"takeoff_s": 2, "land_s": 90}, 50, ("before its landing at 90 s: not flown",)),
        ({"takeoff_s": 2, "trajectory": {"start_s": 60, "expressions": {"x_c": "t"}}}, 50, ("before its trajectory at 60 s: not flown",)),
        ({"takeoff_s": 20, "land_s": 90}, 91, ()),
        ({"trajectory": {"start_s": 60, "expressions": {"x_c": "t"}}}, 50, ()),
        ({}, 5, ()),
    ],
)  # fmt: skip
def test_plan_parts_after_the_end_of_the_run_are_reported(plan: Any, duration_s: float, terms: tuple[str, ...]):
    cluster = {"name": "c", "drones": ["drone1", "drone2"], "plan": plan}
    scenario = scenario_file.resolve(document(clusters=[cluster], duration_s=duration_s), "step.yaml")
    lines = unflown_plans(scenario)
    assert len(lines) == bool(terms)
    assert all(has_terms(line, *terms) for line in lines)
