"""Measurement models against geometry and finite differences; the update at a gate against filterpy."""

from collections.abc import Callable

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from scipy.spatial.transform import Rotation
from synthetic_flight import GATE_S, Flight, estimator, readings, scenario

from zsim.math.rotation import LEVEL, matrix
from zsim_agents.estimation.filter_state import NOMINAL, SETTING, Rows, reckoning
from zsim_agents.estimation.measurement_update import (
    correct,
    write_baro,
    write_flow,
    write_gps,
    write_mag,
    write_sonar,
)
from zsim_agents.estimation.strapdown import corrected

ZERO = (0.0, 0.0, 0.0)
ARM, W = (0.11, -0.07, 0.05), (3.7, -2.0, 1.5)  # m, rad/s
LAG = 0.2  # s
FIELD = (-2.8, 17.8, 14.0)  # uT
MOUNT = Rotation.from_euler("ZYX", [40.0, -20.0, 10.0], degrees=True)
P_W, V_W = np.array([3.0, -4.0, 5.0]), np.array([1.5, -0.7, 0.4])
ATTITUDE = Rotation.from_euler("ZYX", [120.0, 15.0, -10.0], degrees=True)


def triple(values) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def flat(turned: Rotation):
    x, y, z = map(tuple, turned.as_matrix().tolist())
    return x, y, z


def gps(H, p, v, R):
    return write_gps(H, 1, p, v, R, W, ARM, LAG)


def mag(H, p, v, R):
    return write_mag(H, 1, R, flat(MOUNT), FIELD)


def baro(H, p, v, R):
    return (write_baro(H, 1, p, R, ARM, LAG),)


def sonar(H, p, v, R):
    return (write_sonar(H, 1, p, R, ARM, triple(-MOUNT.as_matrix()[:, 2]), 0.4, LAG),)


def flow(H, p, v, R):
    return write_flow(H, 1, v, R, W, ARM)


@pytest.mark.parametrize("model", [gps, mag, baro, sonar, flow])
def test_jacobians_are_the_derivatives_of_the_predictions(model: Callable):
    def predicted(error) -> np.ndarray:
        v = V_W + error[3:6]
        p = P_W + error[0:3] - LAG * error[3:6]  # the past position, whose error depends on the lag
        turned = Rotation.from_rotvec(error[6:9]) * ATTITUDE
        return np.array(model(np.zeros((8, 12)), triple(p), triple(v), flat(turned)))

    H = np.zeros((8, 12))
    rows = len(model(H, triple(P_W), triple(V_W), flat(ATTITUDE)))
    h = 1e-6
    numeric = np.stack([(predicted(h * e) - predicted(-h * e)) / (2.0 * h) for e in np.eye(9)], 1)
    assert H[1 : 1 + rows, :9] == pytest.approx(numeric, abs=1e-7)
    assert not H[0].any()
    assert not H[1 + rows :].any()
    assert not H[:, 9:].any()


def test_predictions_agree_with_the_geometry():
    H = np.zeros((8, 12))
    R = ATTITUDE.as_matrix()
    p, v = P_W + R @ ARM, V_W + R @ np.cross(W, ARM)
    yaw = Rotation.from_euler("z", ATTITUDE.as_euler("ZYX")[0])
    assert gps(H, triple(P_W), triple(V_W), flat(ATTITUDE)) == pytest.approx((*p, *v))
    assert baro(H, triple(P_W), triple(V_W), flat(ATTITUDE)) == pytest.approx((p[2],))
    assert flow(H, triple(P_W), triple(V_W), flat(ATTITUDE)) == pytest.approx(yaw.inv().apply(v))
    seen = (ATTITUDE * MOUNT).inv().apply(FIELD)
    assert mag(H, triple(P_W), triple(V_W), flat(ATTITUDE)) == pytest.approx(seen)
    ray = (ATTITUDE * MOUNT).apply([0.0, 0.0, -1.0])
    (distance,) = sonar(H, triple(P_W), triple(V_W), flat(ATTITUDE))
    assert (p + distance * ray)[2] == pytest.approx(0.4)  # the floor


def test_a_sonar_pointing_upwards_gives_no_information():
    H = np.zeros((1, 12))
    up = (0.0, 0.0, 1.0)
    assert write_sonar(H, 0, (0.0, 0.0, 3.0), matrix(LEVEL), ZERO, up, 0.0, 0.0) == 0.0
    assert not H.any()


# The update at a gate


def copy_of(rows: Rows) -> Rows:
    return Rows._make(array.copy() for array in rows)


def test_a_refused_measurement_does_not_affect_the_others():
    rows = estimator(scenario()).bank.rows
    alone, both, P = copy_of(rows), copy_of(rows), np.eye(12)
    H, z, variance = np.zeros((4, 12)), np.array([50.0, 0.1, 0.2, 0.3]), np.full(4, 0.01)
    H[0, 2], H[1:, 3:6] = 1.0, np.eye(3)
    kinds, expected = np.array([3, 5]), np.zeros(4)
    P_both = correct(both, 0, P, H, z, expected, variance, np.array([(0, 1), (1, 3)]), kinds)
    P_alone = correct(alone, 0, P, H[1:], z[1:], expected[1:], variance[1:], np.array([(0, 3)]), kinds[1:])
    assert both.nominal[0, : NOMINAL.t_sample] == pytest.approx(alone.nominal[0, : NOMINAL.t_sample], nan_ok=True)
    assert P_both == pytest.approx(P_alone)


def test_the_update_at_a_gate_equals_that_of_filterpy():
    """A twin has the same past and only the gate's IMU readings: it lacks the update by the other sensors."""
    of = scenario(estimation={"gate_probability": 1 - 1e-12})
    core, twin, gates = estimator(of), estimator(of), 0
    coming = [r for r in readings(Flight(3, start_s=0.5), of, 3, 8.0) if r.sensor in ("imu", *MODELS)]
    for gate in range(1, round(8.0 / GATE_S) + 1):
        t_s = gate * GATE_S
        twin.bank.rows = copy_of(core.bank.rows)
        now = [reading for reading in coming if t_s - GATE_S + 1e-9 < reading.t_s <= t_s + 1e-9]
        for reading in now:
            core.feed(reading)
            if reading.sensor == "imu":
                twin.feed(reading)
        core.close(t_s)
        twin.close(t_s)
        aiding = [reading for reading in now if reading.sensor != "imu"]
        if t_s > 1.0 and aiding and all(abs(reading.t_sample_s - t_s) < 1e-9 for reading in aiding):
            compare(core.bank.rows, twin.bank.rows, aiding)
            gates += 1
    assert gates > 40


def _gps(H, i, p, v, q, w, setting):
    return write_gps(H, i, p, v, matrix(q), w, ZERO, 0.0)


def _mag(H, i, p, v, q, w, setting):
    field = tuple(setting[SETTING.field_W : SETTING.field_W + 3].tolist())
    return write_mag(H, i, matrix(q), matrix((1.0, 0.0, 0.0, 0.0)), field)


def _baro(H, i, p, v, q, w, setting):
    return (write_baro(H, i, p, matrix(q), ZERO, 0.0),)


MODELS = {"gps": (_gps, [2.0] * 3 + [0.43] * 3), "mag": (_mag, [0.94] * 3), "baro": (_baro, [0.1])}


def compare(rows: Rows, before: Rows, aiding) -> None:
    """Update `before` by filterpy, and compare the covariance and the corrected state."""
    n = before.covariance.shape[1]
    p, v, q, _, w, _ = state = reckoning(before.nominal[0])
    H, z, expected, sigma = np.zeros((32, n)), [], [], []
    for reading in aiding:
        model, sigmas = MODELS[reading.sensor]
        expected += model(H, len(z), p, v, q, w, before.setting[0])
        z += np.ravel(reading.values[:2] if reading.sensor == "gps" else reading.values[0]).tolist()
        sigma += sigmas
    reference = ExtendedKalmanFilter(n, len(z))
    reference.x, reference.P = np.zeros(n), before.covariance[0].copy()
    R = np.diag(np.square(sigma))
    reference.update(np.array(z), lambda x: H[: len(z)], lambda x: np.array(expected), R)
    wanted = corrected(state, reference.x, False, float(before.setting[0, SETTING.gravity]))
    assert rows.covariance[0] == pytest.approx(reference.P, rel=1e-9, abs=1e-10)
    for part, reached in zip(wanted, reckoning(rows.nominal[0]), strict=True):
        assert reached == pytest.approx(part, rel=1e-9, abs=1e-9)
