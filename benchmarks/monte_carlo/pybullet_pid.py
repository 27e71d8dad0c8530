"""gym-pybullet-drones with its position controller: three Crazyflies (cf2x) in one Bullet world.

It is not on the package index, so its physics (benchmarks/kernel/pybullet_drones.py) and its DSLPIDControl (MIT
licence) are followed call by call, at 240 Hz and 48 Hz, without its observations, rewards, spaces and log. The drones'
masses are drawn anew for each flight. No sensors, estimators, wind or rotor lag; Bullet's contacts are on.
"""
# pyright: reportMissingImports=false

import argparse
import math
from typing import Any

import numpy as np
import pybullet
from scipy.spatial.transform import Rotation

from benchmarks.kernel import pybullet_drones as bodies
from benchmarks.monte_carlo.way import Way
from benchmarks.monte_carlo.worker import Flown, Fly, serve

MASS_STD = 0.01  # relative to the mass; design choice, so that flights differ
# The following are DSLPIDControl's constants for cf2x
P_FORCE, I_FORCE, D_FORCE = np.array([0.4, 0.4, 1.25]), np.array([0.05, 0.05, 0.05]), np.array([0.2, 0.2, 0.5])
P_TORQUE, D_TORQUE = np.array([70000.0, 70000.0, 60000.0]), np.array([20000.0, 20000.0, 12000.0])
I_TORQUE = np.array([0.0, 0.0, 500.0])
PWM_TO_RPM, RPM_AT_0, PWM_MIN, PWM_MAX = 0.2685, 4070.3, 20000.0, 65535.0
MIXER = np.array([[-0.5, -0.5, -1.0], [-0.5, 0.5, 1.0], [0.5, 0.5, -1.0], [0.5, -0.5, 1.0]])


def main() -> None:
    serve(build, seconds=330.0)


def build(way: Way, given: argparse.Namespace) -> Fly:
    """Return a function that flies three drones in one Bullet world, starting where those of Test 1 stand."""
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -bodies.GRAVITY_M_S2, physicsClientId=client)
    pybullet.setRealTimeSimulation(0, physicsClientId=client)
    pybullet.setTimeStep(1 / bodies.STEP_HZ, physicsClientId=client)
    drones = bodies._load(3, client)
    steps = round(min(given.seconds, way.span_s) * bodies.CONTROL_HZ)

    def flown(seed: int) -> Flown:
        rng = np.random.default_rng([seed, given.worker])
        for k, drone in enumerate(drones):
            _put(drone, client, way.p_W[0, k], way.yaw[0, k], bodies.MASS_KG * (1.0 + MASS_STD * rng.normal()))
        squares, closest = _follow(way, drones, client, steps)
        return Flown(steps / bodies.CONTROL_HZ / way.span_s, math.sqrt(squares / (3 * steps)), closest)

    return flown


def _put(drone: int, client: int, p_W: np.ndarray, yaw: float, mass_kg: float) -> None:
    attitude = pybullet.getQuaternionFromEuler([0, 0, yaw])
    pybullet.resetBasePositionAndOrientation(drone, list(p_W), attitude, physicsClientId=client)
    pybullet.resetBaseVelocity(drone, [0, 0, 0], [0, 0, 0], physicsClientId=client)
    pybullet.changeDynamics(drone, -1, mass=mass_kg, physicsClientId=client)


def _follow(way: Way, drones: list[int], client: int, steps: int) -> tuple[float, float]:
    """Fly `steps` control steps; return the sum of squared distances from the paths and the closest approach."""
    controls = [Control(way.yaw[0, k]) for k in range(3)]
    squares, closest, p_W = 0.0, math.inf, np.zeros((3, 3))
    for step in range(steps):
        i = way.at(step / bodies.CONTROL_HZ)
        rpms = []
        for k, drone in enumerate(drones):
            p, q = pybullet.getBasePositionAndOrientation(drone, physicsClientId=client)
            v, _ = pybullet.getBaseVelocity(drone, physicsClientId=client)
            p_W[k] = p
            rpms.append(controls[k].rpm(p_W[k], q, np.array(v), way.p_W[i, k], way.v_W[i, k], way.yaw[i, k]))
        for _ in range(bodies.STEP_HZ // bodies.CONTROL_HZ):
            for drone, rpm in zip(drones, rpms, strict=True):
                bodies._push(drone, client, rpm)
            pybullet.stepSimulation(physicsClientId=client)
        squares += float(np.sum((p_W - way.p_W[i]) ** 2))
        closest = min(closest, float(np.sum((p_W - p_W[[1, 2, 0]]) ** 2, axis=1).min()))
    return squares, math.sqrt(closest)


class Control:
    def __init__(self, yaw: float) -> None:
        self._rpy = np.array([0.0, 0.0, yaw])
        self._p_sum, self._turn_sum = np.zeros(3), np.zeros(3)

    def rpm(self, p: np.ndarray, q: Any, v: np.ndarray, p_d: np.ndarray, v_d: np.ndarray, yaw: float) -> Any:
        """Return rotor speeds [rpm]; `q` is (x, y, z, w), and `p_d`, `v_d` and `yaw` are desired."""
        R = np.array(pybullet.getMatrixFromQuaternion(q)).reshape(3, 3)
        thrust, R_d = self._position(p, v, R, p_d, v_d, yaw)
        return self._attitude(thrust, q, R, R_d)

    def _position(
        self, p: np.ndarray, v: np.ndarray, R: np.ndarray, p_d: np.ndarray, v_d: np.ndarray, yaw: float
    ) -> tuple[float, np.ndarray]:
        """Return the thrust as PWM and the desired attitude, as `_dslPIDPositionControl` does."""
        p_e = p_d - p
        self._p_sum = np.clip(self._p_sum + p_e / bodies.CONTROL_HZ, -2.0, 2.0)
        self._p_sum[2] = np.clip(self._p_sum[2], -0.15, 0.15)
        force = P_FORCE * p_e + I_FORCE * self._p_sum + D_FORCE * (v_d - v)
        force[2] += bodies.GRAVITY_M_S2 * bodies.MASS_KG
        thrust = (math.sqrt(max(0.0, force @ R[:, 2]) / (4 * bodies.KF)) - RPM_AT_0) / PWM_TO_RPM
        z = force / np.linalg.norm(force)
        y = np.cross(z, [math.cos(yaw), math.sin(yaw), 0.0])
        y /= np.linalg.norm(y)
        R_d = np.vstack([np.cross(y, z), y, z]).T
        return thrust, Rotation.from_euler("XYZ", Rotation.from_matrix(R_d).as_euler("XYZ")).as_matrix()

    def _attitude(self, thrust: float, q: Any, R: np.ndarray, R_d: np.ndarray) -> np.ndarray:
        """Return the rotor speeds [rpm], as `_dslPIDAttitudeControl` does."""
        rpy = np.array(pybullet.getEulerFromQuaternion(q))
        turn = R_d.T @ R - R.T @ R_d
        turn_e = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
        rates_e = (self._rpy - rpy) * bodies.CONTROL_HZ
        self._rpy = rpy
        self._turn_sum = np.clip(self._turn_sum - turn_e / bodies.CONTROL_HZ, -1500.0, 1500.0)
        self._turn_sum[:2] = np.clip(self._turn_sum[:2], -1.0, 1.0)
        torques = np.clip(-P_TORQUE * turn_e + D_TORQUE * rates_e + I_TORQUE * self._turn_sum, -3200, 3200)
        return PWM_TO_RPM * np.clip(thrust + MIXER @ torques, PWM_MIN, PWM_MAX) + RPM_AT_0


if __name__ == "__main__":
    main()
