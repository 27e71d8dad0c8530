"""What each sensor should read, and its Jacobian against finite differences."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim.math.rotation import LEVEL, matrix
from zsim_agents.estimation import measurement_update

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
    return measurement_update.write_gps(H, 1, p, v, R, W, ARM, LAG)


def mag(H, p, v, R):
    return measurement_update.write_mag(H, 1, R, flat(MOUNT), FIELD)


def baro(H, p, v, R):
    return (measurement_update.write_baro(H, 1, p, R, ARM, LAG),)


def sonar(H, p, v, R):
    return (measurement_update.write_sonar(H, 1, p, R, ARM, triple(-MOUNT.as_matrix()[:, 2]), LAG),)


def flow(H, p, v, R):
    return measurement_update.write_flow(H, 1, v, R, W, ARM)


@pytest.mark.parametrize("model", [gps, mag, baro, sonar, flow])
def test_jacobians_are_the_derivatives_of_the_predictions(model: Callable):
    def predicted(error) -> np.ndarray:
        v = V_W + error[3:6]
        p = P_W + error[0:3] - LAG * error[3:6]  # the past position whose error `lag` maps
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


def test_predictions_are_what_the_geometry_says():
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
    assert (p + distance * ray)[2] == pytest.approx(0.0)


def test_a_sonar_that_looks_up_says_nothing():
    H = np.zeros((1, 12))
    up = (0.0, 0.0, 1.0)
    assert measurement_update.write_sonar(H, 0, (0.0, 0.0, 3.0), matrix(LEVEL), ZERO, up, 0.0) == 0.0
    assert not H.any()
