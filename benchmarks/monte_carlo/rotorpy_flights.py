"""RotorPy's own simulation of quadrotors with the AR.Drone's mass, inertia, rotors and drag, in gusts of 0.5 m/s.

RotorPy's step of 10 ms, SE(3) controller, noisy IMU and Dryden gusts. Drones fly one after the other by
`Environment.run`, with motion capture and a wind EKF whose estimates nothing reads (the controller is given the truth),
integrated by scipy's Runge-Kutta 4(5); or many flights at once by `simulate_batch` on torch (`--batch`), with neither
motion capture nor EKF, by one RK4 step per 10 ms, the cheapest choice. Only some seconds of a flight are simulated, as
every step takes the same time. No cluster controller, GPS, sonar, recording or contacts.
"""
# pyright: reportMissingImports=false

import argparse
import copy
from typing import Any

import numpy as np
from rotorpy.controllers.quadrotor_control import BatchedSE3Control, SE3Control
from rotorpy.environments import Environment
from rotorpy.estimators.wind_ekf import WindEKF
from rotorpy.sensors.imu import BatchedImu
from rotorpy.simulate import simulate_batch
from rotorpy.vehicles.hummingbird_params import quad_params as hummingbird
from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams, Multirotor
from rotorpy.wind.dryden_winds import BatchedDrydenGust, DrydenGust
from rotorpy.world import World

from benchmarks.monte_carlo.way import Way
from benchmarks.monte_carlo.worker import Flown, Fly, serve

STEP_S = 0.01  # RotorPy's default
START_S = 40.0  # time in Test 1 at which flights begin: the formation is climbing and moving
GUST_M_S = 0.5  # scenarios/step.yaml
THRUST_N_S2, HOVER_RAD_S = 8.048e-6, 361.5  # k from zsim/vehicles/ardrone2.py; sqrt(m g / (4 k))
ARM_XY_M = 0.1785 / np.sqrt(2.0)  # zsim/vehicles/ardrone2.py
CORNERS = ((1, 1), (1, -1), (-1, -1), (-1, 1))  # in the order of RotorPy's rotors
ROTOR_POS_M = {f"r{k}": ARM_XY_M * np.array([x, y, 0.0]) for k, (x, y) in enumerate(CORNERS, 1)}
ARDRONE = {
    **hummingbird,
    "mass": 0.429,  # kg; this and the following as in the scenarios' model ardrone2
    "Ixx": 2.237568e-3,  # kg m^2
    "Iyy": 2.985236e-3,  # kg m^2
    "Izz": 4.80374e-3,  # kg m^2
    "rotor_pos": ROTOR_POS_M,
    "k_eta": THRUST_N_S2,
    "k_m": 2.423e-7,  # N m s^2
    "k_d": 0.249 / (4 * HOVER_RAD_S),  # drag of 0.249 N s/m, divided by the sum of the rotor speeds in hover
    "tau_m": 0.030,  # s
    "rotor_speed_min": 126.0,  # rad/s
    "rotor_speed_max": 503.0,  # rad/s
}


def main() -> None:
    serve(build, batch=False, flights=1, seconds=3.0)


def build(way: Way, given: argparse.Namespace) -> Fly:
    """Return a function that flies Test 1 from START_S on."""
    return _batch(way, given.flights, given.seconds) if given.batch else _objects(way, given.seconds)


class Follow:
    """The path of one drone as a RotorPy trajectory."""

    def __init__(self, way: Way, drone: int) -> None:
        self._way, self._drone = way, drone

    def update(self, t: float) -> dict[str, Any]:
        i, none = self._way.at(START_S + t), np.zeros(3)
        x, v = self._way.p_W[i, self._drone], self._way.v_W[i, self._drone]
        flat = {"x": x, "x_dot": v, "x_ddot": none, "x_dddot": none, "x_ddddot": none}
        return {**flat, "yaw": self._way.yaw[i, self._drone], "yaw_dot": 0.0, "yaw_ddot": 0.0}


def _objects(way: Way, seconds: float) -> Fly:
    def flown(seed: int) -> Flown:
        np.random.seed(seed)  # RotorPy draws from NumPy's global generator
        p_W = np.stack([_flown_alone(way, k, seconds) for k in range(3)], axis=1)
        return _judged(way, p_W[:, None], seconds)

    return flown


def _flown_alone(way: Way, drone: int, seconds: float) -> np.ndarray:
    """Fly one drone; return its positions, (steps + 1, 3)."""
    vehicle = Multirotor(ARDRONE, initial_state=_state(way, drone))
    environment = Environment(
        vehicle,
        SE3Control(ARDRONE),
        Follow(way, drone),
        wind_profile=DrydenGust(dt=STEP_S, sig_wind=np.full(3, GUST_M_S), altitude=15.0),
        estimator=WindEKF(ARDRONE, dt=STEP_S),
        sim_rate=round(1 / STEP_S),
    )
    return environment.run(t_final=seconds)["state"]["x"]


def _state(way: Way, drone: int) -> dict[str, np.ndarray]:
    i = way.at(START_S)
    yaw = way.yaw[i, drone]
    return {
        "x": way.p_W[i, drone],
        "v": way.v_W[i, drone],
        "q": np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]),
        "w": np.zeros(3),
        "wind": np.zeros(3),
        "rotor_speeds": np.full(4, HOVER_RAD_S),
    }


class FollowAll:
    """The paths of all drones in all flights as one batched RotorPy trajectory, evaluated for all drones at once."""

    def __init__(self, way: Way, flights: int) -> None:
        import torch

        self._way = way
        self._p_W, self._v_W = (torch.from_numpy(np.tile(found, (1, flights, 1))) for found in (way.p_W, way.v_W))
        self._yaw = torch.from_numpy(np.tile(way.yaw, (1, flights)))
        self._none, self._no_rate = torch.zeros(3 * flights, 3), torch.zeros(3 * flights)

    def update(self, t: Any) -> dict[str, Any]:
        i = self._way.at(START_S + float(t[0]))
        flat = {"x": self._p_W[i], "x_dot": self._v_W[i], "yaw": self._yaw[i]}
        flat |= dict.fromkeys(("x_ddot", "x_dddot", "x_ddddot"), self._none)
        return {**flat, "yaw_dot": self._no_rate, "yaw_ddot": self._no_rate}


def _batch(way: Way, flights: int, seconds: float) -> Fly:
    import torch

    torch.set_num_threads(1)
    device, count = torch.device("cpu"), 3 * flights
    each = [_state(way, k % 3) for k in range(count)]
    start = {name: torch.from_numpy(np.stack([state[name] for state in each])) for name in each[0]}
    params = BatchedMultirotorParams([ARDRONE] * count, count, device)
    follow, gusts = FollowAll(way, flights), torch.full((count, 3), GUST_M_S)

    def flown(seed: int) -> Flown:
        torch.manual_seed(seed)
        found = simulate_batch(
            World.empty((-100, 100, -100, 100, -100, 100)),
            copy.deepcopy(start),
            BatchedMultirotor(params, count, start, device, integrator="rk4"),
            BatchedSE3Control(params, count, device),
            follow,
            BatchedDrydenGust(dt=STEP_S, avg_wind=torch.zeros(count, 3), sig_wind=gusts, altitude=15.0),
            BatchedImu(count, sampling_rate=round(1 / STEP_S)),
            np.full(count, seconds),
            STEP_S,
            safety_margin=0.25,
            terminate=False,
            check_collisions=False,
        )
        return _judged(way, np.asarray(found[1]["x"]).reshape(-1, flights, 3, 3), seconds)

    return flown


def _judged(way: Way, p_W: np.ndarray, seconds: float) -> Flown:
    """Return the results of flights with the positions `p_W`, (steps + 1, flights, 3, 3)."""
    meant = np.stack([way.p_W[way.at(START_S + k * STEP_S)] for k in range(len(p_W))])[:, None]
    rms_m = float(np.sqrt(np.mean(np.sum((p_W - meant) ** 2, axis=-1))))
    apart = np.linalg.norm(p_W - np.roll(p_W, 1, axis=2), axis=-1)
    return Flown(p_W.shape[1] * seconds / way.span_s, rms_m, float(apart.min()))


if __name__ == "__main__":
    main()
