"""Fields as a reader knows them."""

import pytest

from zsim_analysis.sweep.report.field_names import field_name


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("sensors.gps.position_m.noise", "GPS position noise (m)"),
        ("environment.wind.gust_m_s", "wind gust (m/s)"),
        ("sensors.imu.accel_m_s2.density", "IMU accelerometer density (m/s²/√Hz)"),
        ("sensors.imu.gyro_deg_s.bias_walk", "IMU gyroscope bias walk (deg/s/√s)"),
        ("sensors.gps.dropout", "GPS dropout"),
        ("drones.drone2.mass_kg", "drone2 mass (kg)"),
        ("drones[1].mass_kg", "drone 1 mass (kg)"),
        ("clusters.main.gains.proportional_1_s", "main gains proportional (1/s)"),
        ("clusters.main.plan.takeoff_s", "main plan take-off (s)"),
        ("clusters.main.plan.target.p", "main plan target p (m)"),
        ("clusters.main.plan.target.x_c", "main plan target x_c (m)"),
        ("clusters[0].plan.target.beta", "cluster 0 plan target beta (rad)"),
        ("clusters.main.plan.target.yaw_deg", "main plan target yaw (deg)"),
        ("clusters.main.plan.target[left.phi_2]", "main plan target left.phi_2 (rad)"),
        ("clusters.main.plan.trajectory.waypoints[0].values.w_1", "main plan trajectory waypoints 0 values w_1 (m)"),
        ("clusters.main.plan.trajectory.expressions.z_c", "main plan trajectory expressions z_c (m)"),
        ("clusters.main.plan.trajectory.constants.r", "main plan trajectory constants r"),
        ("clusters.plan.gains.proportional_1_s", "plan gains proportional (1/s)"),
        ("sensors.preset", "sensors preset"),
        ("duration_s", "duration (s)"),
        ("seed", "seed"),
        ("metrics.overshoot_m", "overshoot (m)"),
    ],
)
def test_a_path_has_words_and_a_unit(path: str, name: str) -> None:
    assert str(field_name(path)) == name


def test_a_value_stands_with_its_unit() -> None:
    assert field_name("environment.wind.gust_m_s").at("1.5") == "wind gust 1.5 m/s"
    assert field_name("estimation.flow").at("true") == "estimation flow true"
