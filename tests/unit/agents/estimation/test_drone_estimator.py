"""The estimator of one drone, tested on flights with known truth."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from synthetic_flight import GATE_S, Flight, Reading, estimator, fly, readings, scenario

from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.filter_setup import LEVELLING_S, madgwick_beta
from zsim_agents.estimation.filter_state import Rows
from zsim_agents.estimation.strapdown import levelling_time_s

NAN, INF = math.nan, math.inf
AIDING = ("gps", "mag", "baro", "sonar", "flow")


def flown(seed: int = 1, end_s: float = 20.0, **sections):
    """Return the scenario, flight, readings and estimates of a flight."""
    of = scenario(**sections)
    flight = Flight(seed)
    coming = readings(flight, of, seed, end_s)
    return of, flight, coming, fly(estimator(of), coming, end_s)


def errors(flight: Flight, estimates, after_s: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the errors of position [m], velocity [m/s] and heading [rad] at each gate."""
    t = np.array([t for t, _ in estimates if t > after_s])
    found = [e for t, e in estimates if t > after_s]
    heading = np.array([e.yaw_rad for e in found]) - flight.heading(t)
    position = np.array([e.position_m for e in found]) - flight.position(t)
    return position, np.array([e.velocity_m_s for e in found]) - flight.velocity(t), np.angle(np.exp(1j * heading))


def rms(flight: Flight, estimates, after_s: float = 0.0) -> tuple[np.ndarray, float, float]:
    """Return the RMS error of the position by axis, of the worst axis of the velocity, and of the heading."""
    position, velocity, heading = (np.sqrt(np.mean(e**2, axis=0)) for e in errors(flight, estimates, after_s))
    return position, float(velocity.max()), float(heading)


def covariance(estimate: StateEstimate) -> np.ndarray:
    return np.array(estimate.covariance).reshape(6, 6)


def nees(flight: Flight, estimates, after_s: float) -> float:
    """Return the mean over time of e^T P^-1 e for position and velocity."""
    error = np.hstack(errors(flight, estimates, after_s)[:2])
    P = np.array([covariance(e) for t, e in estimates if t > after_s])
    return float(np.mean(np.einsum("ni,ni->n", error, np.linalg.solve(P, error[:, :, None])[:, :, 0])))


def test_errors_are_within_the_limits_of_the_sensors():
    _, flight, _, estimates = flown(end_s=40.0)
    (east, north, up), velocity, heading = rms(flight, estimates, 20.0)
    assert max(east, north) < 0.45  # m; sigma is 0.2 m and the error varies slowly
    assert up < 0.03
    assert velocity < 0.04  # m/s
    assert heading < 0.01  # rad
    end = estimates[-1][1]
    vectors = (end.position_m, end.velocity_m_s, end.orientation_wxyz, end.covariance, end.gyro_bias_rad_s)
    assert {type(x) for vector in (*vectors, (end.yaw_rad, end.yaw_sigma_rad)) for x in vector} == {float}
    assert {type(n) for pair in end.sensors.values() for n in pair} == {int}
    assert end.yaw_rad == pytest.approx(Rotation.from_quat(end.orientation_wxyz, scalar_first=True).as_euler("ZYX")[0])


@pytest.mark.parametrize(
    "sections",
    [
        {"estimation": {"madgwick_beta": 0.1}},
        pytest.param({"estimation": {"madgwick_beta": 0.0}}, marks=pytest.mark.soak),
        pytest.param({"estimation": {"flow": False}}, marks=pytest.mark.soak),
        pytest.param({"estimation": {"magnetometer": False}}, marks=pytest.mark.soak),
    ],
    ids=["beta .1", "gyro alone", "no flow", "no magnetometer"],
)
def test_the_covariance_is_consistent_with_the_errors(sections):
    of = scenario(**sections, yaw_deg=0.0)
    end_s, means = 25.0, []
    for seed in range(6):
        flight = Flight(seed)
        flight.yaw_start = 0.0
        means.append(nees(flight, fly(estimator(of), readings(flight, of, seed, end_s), end_s), 12.0))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(means)) / len(means)
    assert low < np.mean(means) < high


def test_innovations_are_white_with_the_stated_covariance():
    """Each fix is compared with a twin estimator without it; successive innovations are uncorrelated."""
    of, flight = scenario(estimation={"gate_probability": 0.999999}), Flight(2)
    core, twin, normalised = estimator(of), estimator(of), []
    by_gate: dict[int, list[Reading]] = {}
    for reading in readings(flight, of, 2, 60.0):
        by_gate.setdefault(math.ceil(reading.t_s / GATE_S - 1e-6), []).append(reading)
    for gate in range(1, round(60.0 / GATE_S) + 1):
        twin.bank.rows = Rows._make(array.copy() for array in core.bank.rows)
        fixes = [reading for reading in by_gate[gate] if reading.sensor == "gps"]
        for reading in by_gate[gate]:
            core.feed(reading)
            if reading not in fixes:
                twin.feed(reading)
        core.close(gate * GATE_S)
        before = twin.close(gate * GATE_S)
        for fix in fixes:
            y = np.concatenate(fix.values[:2]) - (*before.position_m, *before.velocity_m_s)
            S = covariance(before) + np.diag([2.0**2] * 3 + [0.43**2] * 3)
            normalised.append(np.linalg.solve(np.linalg.cholesky(S), y))
    y = np.array(normalised[5:])  # after the first second
    assert len(y) == 295
    assert np.mean(y**2) == pytest.approx(1.0, abs=3.0 * math.sqrt(2.0 / y.size) + 0.02)
    assert np.abs(np.mean(y[1:] * y[:-1], axis=0)).max() < 4.0 / math.sqrt(len(y))


@pytest.mark.parametrize("name", AIDING)
def test_an_outlier_is_refused_and_counted(name: str):
    of, flight = scenario(), Flight(3, start_s=100.0)
    outlier = {
        "gps": ((60.0, 2.0, 0.0), (0.0, 0.0, 0.0), 2.0, 3),
        "mag": ((80.0, 0.0, 0.0),),
        "baro": (9.0,),
        "sonar": (2.0, True),
        "flow": ((4.0, 0.0, 0.0), 1.0),
    }[name]
    coming = readings(flight, of, 3, 10.0)
    if name == "sonar":  # on the ground the range is below the sonar's minimum
        coming = [r._replace(values=(0.05, True)) if r.sensor == "sonar" else r for r in coming]
    core = estimator(of)
    before = fly(core, coming, 10.0)[-1][1]
    core.feed(Reading(10.02, name, 10.02, outlier))
    after = core.close(10.02)
    assert after.sensors[name] == (before.sensors[name][0], before.sensors[name][1] + 1)
    assert after.position_m == pytest.approx(before.position_m, abs=0.01)
    assert after.yaw_rad == pytest.approx(before.yaw_rad, abs=1e-3)


@pytest.mark.parametrize("bad", [NAN, INF, -INF, 1e300], ids=str)
def test_values_that_are_not_finite_are_refused_counted_and_harmless(bad: float):
    of, _, coming, clean = flown(seed=4, end_s=8.0)
    poison = [
        ("imu", ((bad, 0.0, 9.8), (0.0, 0.0, 0.0))),
        ("imu", ((0.0, 0.0, 9.8), (0.0, bad, 0.0))),
        ("gps", ((0.0, bad, 0.0), (0.0, 0.0, 0.0), 2.0, 3)),
        ("gps", ((0.0, 0.0, 0.0), (0.0, 0.0, bad), 2.0, 3)),
        ("gps", ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), bad, 3)),
        ("mag", ((0.0, 0.0, bad),)),
        ("baro", (bad,)),
        ("sonar", (bad, True)),
        ("flow", ((0.0, 0.0, bad), 1.0)),
    ]
    extra = [Reading(4.003, name, 4.003, values) for name, values in poison]
    tampered = fly(estimator(of), sorted([*coming, *extra], key=lambda r: r.t_s), 8.0)
    end, unharmed = tampered[-1][1], clean[-1][1]
    assert end.position_m == unharmed.position_m
    assert end.covariance == unharmed.covariance
    refused = {name: end.sensors[name][1] - unharmed.sensors[name][1] for name in end.sensors}
    assert refused == {"imu": 2, "gps": 3, "mag": 1, "baro": 1, "sonar": 1, "flow": 1}


def test_duplicates_change_nothing_and_old_readings_are_refused():
    of, _, coming, clean = flown(seed=5, end_s=8.0)
    assert fly(estimator(of), coming, 8.0) == clean  # the result is deterministic to the bit
    twice = [r for reading in coming for r in (reading, reading)]
    assert fly(estimator(of), twice, 8.0)[-1][1] == clean[-1][1]
    old = [next(r for r in coming if r.sensor == name)._replace(t_s=5.001) for name in ("gps", "imu")]
    end = fly(estimator(of), sorted([*coming, *old], key=lambda r: r.t_s), 8.0)[-1][1]
    assert end.position_m == clean[-1][1].position_m
    for name in ("gps", "imu"):
        assert end.sensors[name][1] == clean[-1][1].sensors[name][1] + 1


def test_the_order_within_a_gate_hardly_matters():
    of, _, coming, clean = flown(seed=6, end_s=10.0)

    def backwards(reading: Reading) -> tuple[int, int, float]:
        gate = math.ceil(reading.t_s / GATE_S - 1e-9)
        return gate, len(AIDING) if reading.sensor == "imu" else -AIDING.index(reading.sensor), reading.t_s

    core, end, waiting = estimator(of), clean[0][1], sorted(coming, key=backwards)
    for k in range(1, round(10.0 / GATE_S) + 1):
        while waiting and waiting[0].t_s <= k * GATE_S + 1e-9:
            core.feed(waiting.pop(0))
        end = core.close(k * GATE_S)
    assert end.position_m == pytest.approx(clean[-1][1].position_m, abs=1e-6)


def test_gps_without_a_fix_and_flow_without_quality_are_refused():
    of, _, coming, clean = flown(seed=7, end_s=6.0)
    blind = [
        r._replace(values=(*r.values[:3], 0)) if r.sensor == "gps" and r.t_s > 4.0
        else r._replace(values=(r.values[0], 0.0)) if r.sensor == "flow" and r.t_s > 4.0
        else r
        for r in coming
    ]  # fmt: skip
    end = fly(estimator(of), blind, 6.0)[-1][1]
    assert end.sensors["gps"] == (20, 10)
    assert end.sensors["flow"][1] == 30
    assert covariance(end)[0, 0] > covariance(clean[-1][1])[0, 0]


@pytest.mark.parametrize("yaw_deg", [-170.0, -60.0, 0.0, 95.0, 179.0])
def test_the_heading_converges_from_any_start(yaw_deg: float):
    of = scenario(yaw_deg=yaw_deg + 70.0)  # the scenario's own heading must not matter
    flight = Flight(8, start_s=100.0)
    flight.yaw_start = math.radians(yaw_deg)
    estimates = fly(estimator(of), readings(flight, of, 8, 3.0), 3.0)
    off = np.abs(errors(flight, estimates)[2])
    assert off[int(0.1 / GATE_S)] < 0.25  # rad; the first one or two readings have a noise of 0.05 rad
    assert off[-1] < min(0.03, 4.0 * estimates[-1][1].yaw_sigma_rad)


def test_the_scenario_gives_the_heading_without_a_magnetometer():
    flight = Flight(9, start_s=100.0)
    flight.yaw_start = math.radians(-100.0)
    of = scenario(yaw_deg=-100.0, estimation={"magnetometer": False})
    estimates = fly(estimator(of), readings(flight, of, 9, 3.0), 3.0)
    assert abs(errors(flight, estimates)[2][-1]) < 0.01
    assert estimates[-1][1].yaw_sigma_rad == pytest.approx(0.05, rel=0.1)
    assert estimates[-1][1].sensors["mag"] == (0, 0)


def test_a_gyro_bias_is_estimated_with_a_symmetric_positive_covariance():
    quiet = {"gyro_deg_s": {"noise": 0.06, "bias": 0.0, "bias_walk": 0.0, "quantum": 0.0}}
    bias = (0.002, -0.003, 0.0015)  # rad/s; the preset's sigma is 0.0017
    coming = [
        r._replace(values=(r.values[0], tuple(np.add(r.values[1], bias).tolist()))) if r.sensor == "imu" else r
        for r in readings(Flight(10), scenario(preset="ardrone2", sensors={"imu": quiet}), 10, 40.0)
    ]
    estimates = fly(estimator(scenario(preset="ardrone2")), coming, 40.0)
    for _, estimate in estimates[::50]:
        P = covariance(estimate)
        assert (P == P.T).all()
        assert np.linalg.eigvalsh(P).min() > 0.0
    end = estimates[-1][1]
    assert end.gyro_bias_rad_s == pytest.approx(bias, abs=3e-4)


def test_late_fixes_are_compared_with_the_past_state():
    """At a steady 2 m/s, an uncompensated latency of 400 ms is an error of 0.8 m."""
    of = scenario(sensors={"gps": {"latency_ms": 400.0, "position_m": {"noise": 0.05}}})
    cruise = 2.0  # m/s
    core = estimator(of)
    P = np.diag([1.0] * 3 + [0.01] * 3).ravel()
    level = (1.0, 0.0, 0.0, 0.0)
    core.warm_start(StateEstimate((0.0, 0.0, 10.0), (cruise, 0.0, 0.0), level, 0.0, P, 0.01))
    end = core.close(0.0)
    for k in range(1, 2001):
        t = k * 0.005
        core.feed(Reading(t, "imu", t, ((0.0, 0.0, 9.80665), (0.0, 0.0, 0.0))))
        if k % 40 == 0 and t > 0.4:
            fix = ((cruise * (t - 0.4), 0.0, 10.0), (cruise, 0.0, 0.0), 0.05, 3)
            core.feed(Reading(t, "gps", t - 0.4, fix))
        if k % 4 == 0:
            end = core.close(t)
    assert end.position_m == pytest.approx((cruise * 10.0, 0.0, 10.0), abs=0.02)
    assert end.sensors["gps"][1] == 0


def test_latencies_of_all_sensors_are_compensated():
    late = {name: {"latency_ms": {"gps": 300.0, "imu": 10.0}.get(name, 80.0)} for name in (*AIDING, "imu")}
    _, flight, _, estimates = flown(seed=11, end_s=30.0, sensors=late)
    _, velocity, heading = rms(flight, estimates, 15.0)
    assert velocity < 0.045  # m/s
    assert heading < 0.01
    assert nees(flight, estimates, 15.0) < chi2.ppf(0.999, 6)
    assert all(refused <= 2 for _, refused in estimates[-1][1].sensors.values())


MOUNTS = {
    "imu": {"mount": {"position_m": [0.1, -0.2, 0.05], "rpy_deg": [10.0, 20.0, -120.0]}},
    "gps": {"mount": {"position_m": [-0.6, 0.4, 0.9]}, "position_m": {"noise": 0.1}},
    "mag": {"mount": {"rpy_deg": [180.0, 10.0, 45.0]}},
    "baro": {"mount": {"position_m": [0.5, 0.5, 0.2]}},
    "sonar": {"mount": {"position_m": [0.2, -0.1, -0.05], "rpy_deg": [10.0, -15.0, 30.0]}},
    "flow": {"mount": {"position_m": [0.3, 0.4, -0.1]}},
}


def test_mounts_of_sensors_are_compensated():
    of, flight = scenario(sensors=MOUNTS), Flight(12, yaw_rate=0.8, accel=0.8)
    coming = readings(flight, of, 12, 30.0)
    estimates = fly(estimator(of), coming, 30.0)
    position, velocity, heading = rms(flight, estimates, 15.0)
    assert position.max() < 0.05  # m; the antenna is offset by 0.9 m in z alone
    assert velocity < 0.045
    assert heading < 0.01
    assert nees(flight, estimates, 15.0) < chi2.ppf(0.999, 6)
    unmounted = {name: {k: v for k, v in s.items() if k != "mount"} for name, s in MOUNTS.items() if name != "imu"}
    wrong = scenario(sensors=unmounted | {"imu": MOUNTS["imu"], "mag": MOUNTS["mag"]})
    assert rms(flight, fly(estimator(wrong), coming, 30.0), 15.0)[0].max() > 0.15  # without the mounts, it is large


def test_biases_of_aiding_sensors_widen_the_covariance():
    biased = {"gps": {"position_m": {"noise": 2.0, "bias": 3.0}}, "baro": {"altitude_m": {"noise": 0.1, "bias": 2.0}}}
    ends = []
    for seed in range(20, 28):
        _, flight, _, estimates = flown(seed=seed, end_s=12.0, sensors=biased)
        ends.append(nees(flight, estimates[-1:], 0.0))
        assert math.sqrt(covariance(estimates[-1][1])[0, 0]) > 2.9
    low, high = chi2.ppf([0.001, 0.999], 6 * len(ends)) / len(ends)
    assert low < np.mean(ends) < high


@pytest.mark.parametrize("preset", ["paper", "ardrone2"])
def test_a_warm_start_continues_the_estimates(preset: str):
    of, flight, coming, unbroken = flown(seed=13, end_s=30.0, preset=preset)
    at = round(20.0 / GATE_S) - 1
    core = estimator(of)
    core.warm_start(unbroken[at][1])
    resumed = fly(core, coming, 30.0, from_s=20.0)
    apart = np.array([a.position_m for _, a in resumed]) - np.array([b.position_m for _, b in unbroken[at + 1 :]])
    assert np.linalg.norm(apart, axis=1).max() < 0.15  # m
    assert np.linalg.norm(apart[0]) < 0.02
    assert rms(flight, resumed)[1] < 0.06
    assert np.abs(errors(flight, resumed)[2]).max() < 0.02
    assert nees(flight, resumed, 20.0) < chi2.ppf(0.999, 6)


def test_a_cold_start_in_flight_converges_even_without_an_imu():
    of, flight, coming, _ = flown(seed=3, end_s=30.0)
    blind = fly(estimator(of), [r for r in coming if r.sensor != "imu"], 20.0)
    assert rms(flight, blind, 10.0)[0].max() < 2.0
    assert blind[-1][1].sensors["imu"] == (0, 0)
    estimates = fly(estimator(of), coming, 30.0, from_s=20.0)
    assert rms(flight, estimates, 22.0)[1] < 0.05  # m/s
    assert np.abs(errors(flight, estimates, 23.0)[2]).max() < 0.03
    assert nees(flight, estimates, 20.0) < chi2.ppf(0.999, 6)


def test_the_covariance_grows_during_an_imu_dropout_and_recovers():
    of, flight, coming, _ = flown(seed=14, end_s=30.0)
    gap = [r for r in coming if not 15.0 < r.t_s < 20.0 or r.sensor == "gps"]
    estimates = {round(t, 2): e for t, e in fly(estimator(of), gap, 30.0)}

    def sigma(t: float) -> float:
        return math.sqrt(covariance(estimates[t])[3, 3])

    assert sigma(15.0) < 0.05
    assert sigma(16.0) > 0.3
    assert sigma(29.0) < 0.05
    assert nees(flight, [(t, e) for t, e in estimates.items() if 15.0 < t < 20.0], 0.0) < 6.0 * 3.0
    assert rms(flight, list(estimates.items()), 25.0)[1] < 0.05


def test_an_estimate_without_readings_is_finite_with_a_wide_covariance():
    core = estimator(scenario())
    estimate = [core.close(k * GATE_S) for k in range(1, 101)][-1]
    assert np.isfinite(estimate.covariance).all()
    assert math.sqrt(covariance(estimate)[0, 0]) >= 100.0
    assert estimate.sensors == dict.fromkeys(("gps", "mag", "baro", "sonar", "flow", "imu"), (0, 0))


def test_a_gps_jump_is_refused_at_first_and_accepted_if_it_persists():
    of, flight, coming, _ = flown(seed=16, end_s=40.0)
    jumped = [
        r._replace(values=(tuple(np.add(r.values[0], (30.0, 0.0, 0.0)).tolist()), *r.values[1:]))
        if r.sensor == "gps" and r.t_s > 15.0
        else r
        for r in coming
    ]
    estimates = fly(estimator(of), jumped, 40.0)
    east = errors(flight, estimates)[0][:, 0]
    assert np.abs(east[: round(24.0 / GATE_S)]).max() < 2.5
    assert east[-1] == pytest.approx(30.0, abs=2.0)


def test_the_madgwick_gain_follows_the_accelerometer_noise():
    gains = {}
    for name, of in {"paper": scenario(), "printed": scenario(sensors={"as_printed": True})}.items():
        imu = of.drones[0].sensors.imu
        gains[name] = madgwick_beta(of.estimation, imu, 9.80665)
        sigma = imu.accel_m_s2.noise / 9.80665
        assert levelling_time_s(gains[name], sigma) == pytest.approx(LEVELLING_S)
    assert gains["paper"] == pytest.approx(4.7e-4, rel=0.02)
    assert gains["printed"] == pytest.approx(4.7e-4 * 9.80665, rel=0.02)
