"""Sensors against independent derivations and against the statistics that a scenario specifies.

Lever arms are never zero and mounts never aligned, as an error in either would otherwise be invisible.
"""

import math

import numpy as np
import pytest
from fleet_samples import samples_of
from scipy import stats
from scipy.spatial.transform import Rotation

from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import Fleet
from zsim_world.sensors.sensor_set import SENSORS, BodyTruth, MountedSensor, Site, flow, gps, imu, mag, sonar

P_BS = (0.11, -0.07, 0.05)
RPY_BS_DEG = (12.0, -25.0, 140.0)
G = 9.80665
FIELD_W = np.array([-2.8, 17.8, 14.0])
SITE = Site(G, tuple(FIELD_W.tolist()))


def pose(t):
    """Return the body's position and attitude on a smooth trajectory."""
    position = np.array([2 * math.sin(0.9 * t), 1.5 * math.cos(1.3 * t), 5 + 0.8 * math.sin(1.7 * t)])
    angles = (0.9 * t + 0.3 * math.sin(2.1 * t), 0.35 * math.sin(2.7 * t), 0.4 * math.cos(3.1 * t))
    return position, Rotation.from_euler("ZYX", angles)


def sensor_pose(t):
    position, attitude = pose(t)
    return position + attitude.apply(P_BS), attitude * mount()


def mount():
    return Rotation.from_euler("ZYX", RPY_BS_DEG[::-1], degrees=True)


def derivatives(t, h=1e-3):
    """Return the body's state at t from differences of its pose alone."""
    (p0, _), (p1, r1), (p2, _) = pose(t - h), pose(t), pose(t + h)
    velocity, accel = (p2 - p0) / (2 * h), (p2 - 2 * p1 + p0) / h**2
    return p1, velocity, accel, r1, body_rate(t), (body_rate(t + h) - body_rate(t - h)) / (2 * h)


def body_rate(t, h=1e-4):
    (_, before), (_, now), (_, after) = pose(t - h), pose(t), pose(t + h)
    return (now.inv() * after).as_rotvec() / (2 * h) - (now.inv() * before).as_rotvec() / (2 * h)


def wxyz(rotation):
    return tuple(rotation.as_quat(scalar_first=True).tolist())


def body(p=(0, 0, 0), v=(0, 0, 0), attitude=None, w=(0, 0, 0), a=(0, 0, 0), alpha=(0, 0, 0)):
    """Return the truth of a drone in the form that compiled code uses."""
    q = wxyz(attitude or Rotation.identity())
    p, v, w, a, alpha = ((float(each[0]), float(each[1]), float(each[2])) for each in (p, v, w, a, alpha))
    return BodyTruth(p, v, q, w, a, alpha)


def mounted(turned, range_max=0.0):
    return MountedSensor(P_BS, wxyz(turned), range_max)


@pytest.mark.parametrize("t", [0.0, 0.7, 2.2, 5.9])
def test_the_imu_measures_the_sensor_s_own_motion(t):
    """The reference is differences of the sensor's own pose; the kernel's formula knows only the body's motion."""
    p, _, accel, attitude, rate, angular = derivatives(t)
    h = 1e-3
    own_p = [sensor_pose(t + k * h)[0] for k in (-1, 0, 1)]
    own_accel = (own_p[2] - 2 * own_p[1] + own_p[0]) / h**2
    own_attitude = sensor_pose(t)[1]
    expected_force = own_attitude.inv().apply(own_accel + np.array([0, 0, G]))
    turned = [(own_attitude.inv() * sensor_pose(t + s * 1e-4)[1]).as_rotvec() for s in (-1, 1)]
    expected_rate = (turned[1] - turned[0]) / 2e-4
    force, gyro = imu(body(attitude=attitude, w=rate, a=accel, alpha=angular), mounted(mount()), SITE)
    np.testing.assert_allclose(force, expected_force, atol=2e-4)
    np.testing.assert_allclose(gyro, expected_rate, atol=2e-6)
    assert np.linalg.norm(np.cross(rate, np.cross(rate, P_BS))) > 0.01  # the lever arm matters here
    assert p.shape == (3,)


@pytest.mark.parametrize("t", [0.0, 0.7, 2.2, 5.9])
def test_gps_flow_and_sonar_measure_at_the_sensor_s_position(t):
    p, velocity, _, attitude, rate, _ = derivatives(t)
    h = 1e-5
    own_velocity = (sensor_pose(t + h)[0] - sensor_pose(t - h)[0]) / (2 * h)
    x = body(p, velocity, attitude, rate)
    place, moving = gps(x, mounted(mount()), SITE)
    np.testing.assert_allclose(place, sensor_pose(t)[0], atol=1e-12)
    np.testing.assert_allclose(moving, own_velocity, atol=1e-5)
    forward = attitude.apply([1, 0, 0])
    to_heading = Rotation.from_euler("z", -math.atan2(forward[1], forward[0]))
    over_ground, _ = flow(x, mounted(mount()), SITE)
    np.testing.assert_allclose(over_ground, to_heading.apply(own_velocity), atol=1e-5)
    small = Rotation.from_euler("ZYX", (40.0, 8.0, -11.0), degrees=True)
    beam = (attitude * small).apply([0, 0, -1.0])
    (distance, echo, _), _ = sonar(x, mounted(small, 50.0), SITE)
    assert echo == 1.0
    assert sensor_pose(t)[0][2] + distance * beam[2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("t", [0.0, 2.2])
def test_the_magnetometer_measures_the_field_in_its_own_axes(t):
    attitude = pose(t)[1]
    field, _ = mag(body(attitude=attitude), mounted(mount()), SITE)
    np.testing.assert_allclose(field, sensor_pose(t)[1].inv().apply(FIELD_W), atol=1e-12)


# Statistics: the drones stand still, so that every reading is a known truth plus an error

STILL = {"imu": (0, 0, G, 0, 0, 0), "mag": (17.8, 2.8, 14.0), "flow": (0, 0, 0)}


def standing(count, overrides, yaw_deg=90.0, seed=3, **sensors_top):
    drones = [{"name": f"d{k}", "position_m": [3.0 * k, 0, 0], "yaw_deg": yaw_deg} for k in range(count)]
    sensor_set = {"preset": "paper", **{name: overrides.get(name, {}) for name in SENSORS}, **sensors_top}
    return Fleet(resolve({"name": "t", "duration_s": 1, "seed": seed, "drones": drones, "sensors": sensor_set}))


def readings(fleet, seconds, sensor):
    """Return the readings of a sensor, (N, samples, values)."""
    rows = [[] for _ in range(fleet.count)]
    for _ in range(round(seconds / 0.02)):
        fleet.advance()
        for sample in samples_of(fleet):
            if sample.sensor == sensor:
                rows[sample.drone].append(sample.values)
    return np.array([row[: min(map(len, rows))] for row in rows])


def assert_sigma(errors, sigma, axis=None):
    """Check a zero-mean spread by a chi-square test, at 1e-4 in either tail."""
    n = errors.size if axis is None else errors.shape[axis]
    ratio = (errors**2).sum(axis=axis) / sigma**2
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], n)
    assert np.all((low < ratio) & (ratio < high)), np.sqrt(ratio / n) * sigma


def test_the_paper_preset_has_its_specified_noise():
    fleet = standing(2, {})
    imu = readings(fleet, 30.0, "imu")[:, 400:] - STILL["imu"]
    assert_sigma(imu[:, :, :3], 0.35)
    assert_sigma(imu[:, :, 3:], math.radians(0.01))
    # white: neighbours are uncorrelated, to four standard deviations of a sample correlation
    x = imu[0, :, 0]
    assert abs(np.corrcoef(x[1:], x[:-1])[0, 1]) < 4 / math.sqrt(len(x))
    for sensor, at, sigma in (("mag", STILL["mag"], 0.94), ("flow", STILL["flow"], 0.1)):
        assert_sigma(readings(fleet, 30.0, sensor)[:, :, :3] - at, sigma)
    gps = readings(fleet, 100.0, "gps")
    truth = fleet.truth().position_m[:, None, :]
    assert_sigma(gps[:, :, 3:6] - truth, 2.0)
    assert_sigma(gps[:, :, 6:9], 0.43)
    assert_sigma(readings(fleet, 30.0, "baro")[:, :, 1] - 0.058, 0.1)


def test_noise_density_adds_with_the_root_of_the_rate():
    model = {"accel_m_s2": {"noise": 0.03, "density": 0.004}, "gyro_deg_s": {"noise": 0.0, "density": 0.01}}
    imu = readings(standing(1, {"imu": model}), 30.0, "imu")[:, 400:] - STILL["imu"]
    assert_sigma(imu[:, :, :3], math.hypot(0.03, 0.004 * math.sqrt(200)))
    assert_sigma(imu[:, :, 3:], math.radians(0.01 * math.sqrt(200)))


def test_bias_is_constant_in_a_run_and_varies_between_drones():
    model = {"velocity_m_s": {"noise": 0.0, "bias": 0.2}}
    flow = readings(standing(60, {"flow": model}), 4.0, "flow")[:, 15:, :3]
    assert np.ptp(flow, axis=1).max() < 1e-3
    assert_sigma(flow[:, 0], 0.2)


def test_a_bias_walk_grows_with_the_root_of_time():
    model = {"field_ut": {"noise": 0.0, "bias_walk": 0.3}}
    mag = readings(standing(40, {"mag": model}), 20.0, "mag") - STILL["mag"]
    assert_sigma(mag[:, -1] - mag[:, 24], 0.3 * math.sqrt(19.0))
    steps = np.diff(mag, axis=1)
    assert_sigma(steps[:, 50:], 0.3 / math.sqrt(25.0))


def test_readings_are_multiples_of_the_quantum():
    model = {"velocity_m_s": {"noise": 0.1, "quantum": 0.25}}
    flow = readings(standing(1, {"flow": model}), 60.0, "flow")[0, :, :3]
    steps = flow / 0.25
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    # a normal number x of sigma 0.1 is read as 0 if |x| < 0.125
    inside = (flow == 0).mean()
    expected = 2 * stats.norm.cdf(1.25) - 1
    assert abs(inside - expected) < 4 * math.sqrt(expected * (1 - expected) / flow.size)


def test_dropout_loses_the_specified_share_independently():
    fleet = standing(1, {"imu": {"dropout": 0.2}})
    times = []
    for _ in range(2500):
        fleet.advance()
        times += [s.t_ns for s in samples_of(fleet) if s.sensor == "imu"]
    n = 2500 * 4
    assert abs(len(times) - 0.8 * n) < 4 * math.sqrt(n * 0.16)
    lost = np.ones(n, bool)
    lost[np.array(times) // 5_000_000 - 1] = False
    pairs = (lost[1:] & lost[:-1]).mean()
    assert abs(pairs - 0.04) < 4 * math.sqrt(0.04 * 0.96 / n)


def test_dropout_can_lose_everything_or_nothing():
    fleet = standing(1, {"gps": {"dropout": 1.0}, "mag": {"dropout": 0.0}})
    assert len(readings(fleet, 4.0, "mag")[0]) == 100
    assert readings(fleet, 4.0, "gps").size == 0


def test_imu_noise_is_uncorrelated_between_drones_samples_and_axes():
    fleet = standing(2, {})
    rows = []
    for _ in range(1500):
        fleet.advance()
        flow = [s.values[:3] for s in samples_of(fleet) if s.sensor == "imu"][:8]
        rows.append(np.ravel(flow[:2] + flow[4:6]))
    correlation = np.corrcoef(np.array(rows[100:]).T) - np.eye(12)
    assert np.abs(correlation).max() < 5 / math.sqrt(1400)


def test_a_rotated_imu_agrees_with_the_truth_in_flight():
    """In gusts, a noiseless IMU on a rotated mount with a lever arm measures the true acceleration and rate there."""
    quiet = {"noise": 0.0}
    sensor = {"mount": {"position_m": list(P_BS), "rpy_deg": list(RPY_BS_DEG)}}
    model = {"imu": {"accel_m_s2": quiet, "gyro_deg_s": quiet, **sensor}}
    drones = [{"name": "d0", "position_m": [0, 0, 0], "yaw_deg": 30.0}]
    document = {"name": "t", "duration_s": 1, "drones": drones, "sensors": {"preset": "paper", **model}}
    fleet = Fleet(resolve({**document, "environment": {"wind": {"gust_m_s": 0.5}}}))
    fleet.takeoff(0)
    rates, checked = [], 0
    for _ in range(600):
        fleet.advance()
        truth = fleet.truth()
        imu = next(s for s in samples_of(fleet) if s.sensor == "imu" and s.t_sample_ns == fleet.t_ns)
        rates.append(truth.angular_velocity_rad_s[0])
        attitude = Rotation.from_quat(truth.orientation_wxyz[0], scalar_first=True)
        np.testing.assert_allclose(mount().apply(imu.values[3:]), rates[-1], atol=1e-12)
        force = attitude.apply(mount().apply(imu.values[:3])) - [0, 0, G]
        if len(rates) > 2 and np.abs(np.array(rates[-3:])).max() < 0.05:
            checked += 1
            np.testing.assert_allclose(force, truth.accel_m_s2[0], atol=0.4)
    assert checked > 50
