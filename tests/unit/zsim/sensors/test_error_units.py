"""Error models in the units of data sheets and of Kalibr, and what is refused of them."""

import math
from typing import Any

import pytest

from zsim.errors import ScenarioError
from zsim.scenario.scenario_file import from_text, resolve, to_text
from zsim.schema.quantities import G_M_S2
from zsim.sensors.error_units import BY_UNIT
from zsim.sensors.sensor import ErrorModel
from zsim.sensors.sensor_catalogue import STOCK


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
def test_a_figure_of_a_data_sheet_is_read_in_its_unit(channel: str, given: dict[str, float], field: str, value: float):
    of = resolved(imu={channel: given})
    assert getattr(getattr(of.drones[0].sensors.imu, channel), field) == pytest.approx(value)
    assert from_text(to_text(of)) == of


def test_kalibrs_file_is_read_as_it_is():
    keys = {"accelerometer_noise_density": 0.0017, "accelerometer_random_walk": 3e-4, "update_rate": 100}
    imu = resolved(imu={**keys, "gyroscope_noise_density": 2e-4, "gyroscope_random_walk": 2e-5}).drones[0].sensors.imu
    assert (imu.rate_hz, imu.accel_m_s2.density, imu.accel_m_s2.bias_walk) == (100, 0.0017, 3e-4)
    assert imu.gyro_deg_s.density == pytest.approx(math.degrees(2e-4))
    assert imu.gyro_deg_s.bias_walk == pytest.approx(math.degrees(2e-5))


def test_what_a_drone_says_wins_over_what_all_share():
    drone = {"name": "a", "position_m": [0, 0, 0], "sensors": {"mag": {"field_ut": {"density_nt_sqrt_hz": 50}}}}
    shared = {"preset": "paper", "mag": {"field_ut": {"density": 0.2}}}
    of = resolve({"name": "t", "duration_s": 1, "sensors": shared, "drones": [drone]})
    assert of.drones[0].sensors.mag.field_ut.density == pytest.approx(0.05)


def test_a_scenario_without_them_has_none_of_the_fields():
    assert not [name for name in ("correlation_s", "bias_instability", "sigma_max") if name in to_text(resolved())]


def test_every_unit_is_of_a_field_and_every_channel_has_units():
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
def test_what_is_wrong_is_a_line(sensors: dict[str, Any], terms: tuple[str, ...]):
    with pytest.raises(ScenarioError) as refused:
        resolved(**sensors)
    assert any(all(term in line for term in terms) for line in refused.value.faults), refused.value.faults


@pytest.mark.parametrize(("field", "bad"), [("sigma_max_m", 0), ("heading_sigma_max_deg", 200)])
def test_limits_of_certainty_are_checked(field: str, bad: float):
    drones = [{"name": name, "position_m": [3 * k, 0, 0]} for k, name in enumerate("ab")]
    cluster = {"name": "main", "drones": ["a", "b"], "gains": {field: bad}}
    with pytest.raises(ScenarioError) as refused:
        resolve({"name": "t", "duration_s": 1, "drones": drones, "clusters": [cluster]})
    assert [line for line in refused.value.faults if f"gains.{field} is {bad}" in line]
