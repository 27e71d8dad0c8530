"""Declared sensors: stock ones, users' modules, and error models in the units of data sheets and of Kalibr."""

import math
from pathlib import Path
from typing import Any

import pytest

from zsim.contract import keys, messages
from zsim.contract.framing import key_table
from zsim.errors import DecodeError, DocumentError, ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.faults import kinds_of
from zsim.scenario.scenario import Scenario
from zsim.scenario.scenario_file import from_text, resolve, to_text
from zsim.schema import plugin
from zsim.schema.message import field_types
from zsim.schema.quantities import G_M_S2
from zsim.sensors import sensor_catalogue
from zsim.sensors.scanner import SCANNERS
from zsim.sensors.sensor import ErrorModel, Sample, as_fields, message_type
from zsim.sensors.sensor_catalogue import BY_UNIT, FIELDS, PRESETS, STOCK, declarations

EXAMPLES = Path(__file__).parents[4] / "examples"
UWB: dict[str, Any] = {"module": "uwb_range", "anchor_m": [1, 2, 3]}


@pytest.fixture(autouse=True)
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))


def scenario(
    faults: list[dict[str, Any]] | None = None, second: dict[str, Any] | None = None, **sensors: Any
) -> Scenario:
    drones: list[dict[str, Any]] = [
        {"name": "d1", "position_m": [0, 0, 0]},
        {"name": "d2", "position_m": [3, 0, 0], "sensors": second or {}},
    ]
    document = {"name": "t", "duration_s": 1, "drones": drones, "faults": faults or [], "sensors": sensors}
    return scenario_file.resolve(document)


def paths(**given: Any) -> list[str]:
    """Return the paths of the faults of a scenario."""
    with pytest.raises(ScenarioError) as refused:
        scenario(**given)
    return [line.removeprefix("scenario: ").split(" ")[0] for line in refused.value.faults]


def test_the_stock_sensors_match_those_of_a_scenario():
    assert tuple(STOCK) == FIELDS[2 : 2 + len(STOCK)] == keys.SENSORS
    assert FIELDS[2 + len(STOCK) :] == ("front_camera", "bottom_camera", keys.SIGHTINGS, *SCANNERS)
    for name, kind in STOCK.items():
        assert messages.type_of(keys.sensor("d1", name)) is kind.message
        assert {channel.settings for channel in kind.channels} < set(kind.settings.__struct_fields__)
        assert kind.presets.keys() == PRESETS.keys()


def test_a_section_is_completed_with_the_defaults_of_its_module():
    made = scenario(my_uwb=UWB, second={"my_uwb": {"rate_hz": 5, "range_m": {"bias": 0.3}}})
    first: Any
    second: Any
    first, second = (
        next(settings for name, _, settings in d.sensors.sections() if name == "my_uwb") for d in made.drones
    )
    assert (first.rate_hz, second.rate_hz) == (10.0, 5.0)
    assert first.anchor_m == second.anchor_m == (1.0, 2.0, 3.0)
    assert (second.range_m.noise, second.range_m.bias) == (0.0, 0.3)


def test_the_resolved_text_is_read_without_the_module(monkeypatch: pytest.MonkeyPatch):
    made = scenario(my_uwb=UWB, pitot={"module": "airspeed"})
    text = scenario_file.to_text(made)
    monkeypatch.setattr(sensor_catalogue, "sensor_type", None)
    again = scenario_file.from_text(text)
    assert again == made
    assert scenario_file.to_text(again) == text
    assert list(declarations(again.drones)) == ["my_uwb", "pitot"]


def test_a_module_whose_message_differs_from_the_scenario_is_refused():
    text = scenario_file.to_text(scenario(my_uwb=UWB)).replace("range_m: number", "distance_m: number")
    read = scenario_file.from_text(text)
    with pytest.raises(DocumentError, match=r"sensors\.my_uwb\.declared"):
        list(read.drones[0].sensors.sections())


@pytest.mark.parametrize(
    ("sensors", "where"),
    [
        ({"sodar": {"rate_hz": 5}}, "sensors.sodar"),
        ({"own": {"rate_hz": 5}}, "sensors.own"),
        ({"Uwb": UWB}, "sensors.Uwb"),
        ({"status": UWB}, "sensors.status"),
        ({"a": {"module": "nowhere.at_all"}}, "sensors.a.module"),
        ({"a": {"module": "math"}}, "sensors.a.module"),
        ({"a": {"module": 5}}, "sensors.a.module"),
        ({"a": UWB | {"anchor_m": [1, 2]}}, "sensors.a.anchor_m"),
        ({"a": UWB | {"rate_hz": 5000}}, "sensors.a.rate_hz"),
        ({"a": UWB | {"range_m": {"noise": -1}}}, "sensors.a.range_m.noise"),
        ({"a": UWB | {"colour": 1}}, "sensors.a.colour"),
    ],
)
def test_a_faulty_section_is_reported_once(sensors: dict[str, Any], where: str):
    assert paths(**sensors) == [where]


def test_only_faults_of_sensors_that_are_not_imported_are_skipped():
    def fault(kind: str) -> dict[str, Any]:
        return {"kind": kind, "target": "d1", "at_s": 0.1}

    kinds = [
        f"{name}_{what}" for name in ("my_uwb", "other") for what in ("dropout", "stuck", "bias", "noise", "drift")
    ]
    with plugin.names_only():
        assert paths(my_uwb=UWB, faults=[*map(fault, kinds)]) == [f"faults[{place}].kind" for place in range(4, 10)]
        assert scenario(second={"my_uwb": UWB}, faults=[fault("my_uwb_bias")]).faults
    assert paths(my_uwb={"module": "not_here"}, faults=[fault("my_uwb_stuck")]) == ["sensors.my_uwb.module"]


def module(path: Path, name: str, text: str) -> dict[str, str]:
    """Write a module with a sensor that measures one number; return its section."""
    head = """
from zsim.schema.message import Number
from zsim.sensors.sensor import Channel, ErrorModel, LatencyMs, RateHz, Sample, Sensor, SensorType
"""
    tail = """
SENSOR = SensorType(
    label="x", message=Mine, settings=Config, channels=(Channel("x"),), equation=lambda truth, settings, environment: [0.0]
)
"""
    (path / f"{name}.py").write_text(head + text + tail)
    return {"module": name}


CONFIG = (
    "class Config(Sensor, frozen=True, kw_only=True):\n    x: ErrorModel = ErrorModel()\n    rate_hz: RateHz = 5.0\n"
)
MINE = "class Mine(Sample, frozen=True):\n    {}: Number\n"


def test_a_sensor_name_stands_for_one_message_type_with_fixed_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    one, other = (module(tmp_path, f"named_{x}", MINE.format(x) + CONFIG) for x in "ab")
    assert scenario(p=one, q=one).drones[0].sensors is not None
    assert paths(a=UWB, second={"a": {"module": "airspeed"}})[0].startswith("drones[1].sensors.a")
    assert paths(p=one, q=other) == [f"drones[{drone}].sensors.q.declared.message" for drone in (0, 1)]


@pytest.mark.parametrize(("field", "is_sound"), [("latency_ms: LatencyMs", True), ("latency_ms: float", False)])
def test_settings_common_to_all_sensors_keep_their_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, field: str, is_sound: bool
):
    monkeypatch.syspath_prepend(str(tmp_path))
    name = f"with_latency_{is_sound}".lower()
    mine = module(tmp_path, name, MINE.format("a") + CONFIG + f"    {field} = 40.0\n")
    if is_sound:
        assert paths(p={**mine, "latency_ms": -50}) == ["sensors.p.latency_ms"]
    else:
        assert paths(p=mine) == ["sensors.p.module"]


def test_faults_of_a_users_sensor_have_its_unit():
    kinds = kinds_of(declarations(scenario(my_uwb=UWB, pitot={"module": "airspeed"}).drones))
    (bias,) = kinds["my_uwb_bias"].parameters
    assert (bias.name, bias.unit, bias.shape) == ("value_m", "m", "number")
    assert kinds["pitot_bias"].parameters[0].name == "value_pa"
    assert {f"my_uwb_{how}" for how in ("dropout", "stuck", "noise")} < kinds.keys()
    sound = {"kind": "my_uwb_bias", "target": "d1", "at_s": 0.5, "value_m": 2.0}
    assert scenario([sound], my_uwb=UWB).faults == [sound]
    assert paths(faults=[{**sound, "kind": "my_uwb_drift"}], my_uwb=UWB) == ["faults[0].kind"]
    assert paths(faults=[{**sound, "value_m": "far"}], my_uwb=UWB) == ["faults[0].value_m"]


def test_message_types_are_known_once_the_run_info_registers_them():
    fields: dict[str, Any] = {"range_m": "number", "place_m": "number[3]", "hits": "whole", "line_of_sight": "flag"}
    key = keys.sensor("d1", "test_ranger")
    assert messages.type_of(key) is None
    messages.register_sensors([messages.SensorInfo("test_ranger", "Ranged", fields)])
    kind: Any = messages.type_of(key)
    assert field_types(kind, Sample) == fields
    sent = kind(1, 0, 1, *as_fields([1.5, 1, 2, 3, 7, 1], fields))
    assert messages.decode(key, messages.encode(sent)) == sent
    assert (sent.place_m, sent.hits, sent.line_of_sight) == ((1.0, 2.0, 3.0), 7, True)
    assert messages.encoding(key) == "application/msgpack;Ranged"
    with pytest.raises(DecodeError, match="range_m"):
        messages.decode(key, messages.encode(kind(1, 0, 1, float("nan"), (1.0, 2.0, 3.0), 7, True)))
    assert key_table(["d1", "d2"], ["my_uwb"]).index("drone/d1/sensor/my_uwb") == 8
    assert message_type("Ranged", fields, "test_ranger") is kind
    assert "drone/*/sensor/test_ranger" not in messages.types_by_shape()


@pytest.mark.parametrize("numbers", [[], [1.0], [1.0, 2.0, 3.0, 4.0, 5.0]])
def test_a_reading_of_the_wrong_length_is_refused(numbers: list[float]):
    with pytest.raises(ValueError, match="place_m"):
        as_fields(numbers, {"range_m": "number", "place_m": "number[3]"})


def resolved(**sensors: Any):
    drones: list[dict[str, Any]] = [{"name": "a", "position_m": [0, 0, 0]}]
    return resolve({"name": "t", "duration_s": 1, "sensors": {"preset": "paper", **sensors}, "drones": drones})


@pytest.mark.parametrize(
    ("channel", "given", "field", "value"),
    [
        ("accel_m_s2", {"noise_density": 0.004}, "density", 0.004),
        ("accel_m_s2", {"random_walk": 0.006}, "bias_walk", 0.006),
        ("accel_m_s2", {"density_ug_sqrt_hz": 175}, "density", 175e-6 * G_M_S2),
        ("accel_m_s2", {"velocity_random_walk_m_s_sqrt_h": 0.6}, "density", 0.01),
        ("accel_m_s2", {"bias_mg": 20}, "bias", 0.02 * G_M_S2),
        ("accel_m_s2", {"bias_instability_ug": 40, "correlation_s": 9}, "bias_instability", 40e-6 * G_M_S2),
        ("gyro_deg_s", {"noise_density": 1e-4}, "density", math.degrees(1e-4)),
        ("gyro_deg_s", {"random_walk": 1e-5}, "bias_walk", math.degrees(1e-5)),
        ("gyro_deg_s", {"density_deg_s_sqrt_hz": 0.014}, "density", 0.014),
        ("gyro_deg_s", {"density_mdeg_s_sqrt_hz": 4}, "density", 0.004),
        ("gyro_deg_s", {"angle_random_walk_deg_sqrt_h": 0.3}, "density", 0.005),
        ("gyro_deg_s", {"bias_deg_h": 36}, "bias", 0.01),
        ("gyro_deg_s", {"bias_instability_deg_h": 36, "correlation_s": 9}, "bias_instability", 0.01),
    ],
)
def test_a_value_from_a_data_sheet_is_read_in_its_unit(channel: str, given: dict[str, float], field: str, value: float):
    of = resolved(imu={channel: given})
    assert getattr(getattr(of.drones[0].sensors.imu, channel), field) == pytest.approx(value)
    assert from_text(to_text(of)) == of


def test_a_kalibr_file_is_read_unchanged():
    keys = {"accelerometer_noise_density": 0.0017, "accelerometer_random_walk": 3e-4, "update_rate": 100}
    imu = resolved(imu={**keys, "gyroscope_noise_density": 2e-4, "gyroscope_random_walk": 2e-5}).drones[0].sensors.imu
    assert (imu.rate_hz, imu.accel_m_s2.density, imu.accel_m_s2.bias_walk) == (100, 0.0017, 3e-4)
    assert imu.gyro_deg_s.density == pytest.approx(math.degrees(2e-4))
    assert imu.gyro_deg_s.bias_walk == pytest.approx(math.degrees(2e-5))


def test_the_settings_of_a_drone_override_the_shared_ones():
    drone = {"name": "a", "position_m": [0, 0, 0], "sensors": {"mag": {"field_ut": {"density_nt_sqrt_hz": 50}}}}
    shared = {"preset": "paper", "mag": {"field_ut": {"density": 0.2}}}
    of = resolve({"name": "t", "duration_s": 1, "sensors": shared, "drones": [drone]})
    assert of.drones[0].sensors.mag.field_ut.density == pytest.approx(0.05)


def test_unused_error_fields_are_not_in_the_resolved_text():
    assert not [name for name in ("correlation_s", "bias_instability", "sigma_max") if name in to_text(resolved())]


def test_every_unit_belongs_to_a_field_and_every_channel_has_units():
    assert {unit.field for units in BY_UNIT.values() for unit in units.values()} <= set(ErrorModel.__struct_fields__)
    assert {channel.unit for kind in STOCK.values() for channel in kind.channels} == set(BY_UNIT)


@pytest.mark.parametrize(
    ("sensors", "terms"),
    [
        ({"gps": {"position_m": {"correlation_s": -1}}}, ("sensors.gps.position_m.correlation_s", "-1", "0")),
        ({"gps": {"position_m": {"correlation_s": "long"}}}, ("sensors.gps.position_m.correlation_s", "long")),
        ({"mag": {"field_ut": {"bias_instability": 1}}}, ("mag.field_ut.bias_instability", "1", "correlation_s")),
        ({"imu": {"gyro_deg_s": {"bias_instability_deg_h": -2}}}, ("imu.gyro_deg_s.bias_instability_deg_h", "-2")),
        ({"imu": {"accel_m_s2": {"density_ug_sqrt_hz": "much"}}}, ("imu.accel_m_s2.density_ug_sqrt_hz", "much")),
        ({"imu": {"accel_m_s2": {"density": 1, "noise_density": 1}}}, ("imu.accel_m_s2.noise_density", "density")),
        ({"imu": {"gyroscope_noise_density": -1}}, ("sensors.imu.gyroscope_noise_density", "-1")),
        ({"imu": {"update_rate": 100, "rate_hz": 100}}, ("sensors.imu.update_rate", "rate_hz")),
        ({"imu": {"update_rate": 400}}, ("imu.rate_hz", "400", "200")),
        ({"gps": {"position_m": {"density_ug_sqrt_hz": 1}}}, ("gps.position_m.density_ug_sqrt_hz", "not", "known")),
    ],
)
def test_invalid_error_settings_are_reported(sensors: dict[str, Any], terms: tuple[str, ...]):
    with pytest.raises(ScenarioError) as refused:
        resolved(**sensors)
    assert any(all(term in line for term in terms) for line in refused.value.faults), refused.value.faults
