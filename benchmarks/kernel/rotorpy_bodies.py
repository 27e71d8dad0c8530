"""RotorPy's vehicle with rotor speeds as commands: stepped drone by drone, or as a batch on torch (`--batch`).

RotorPy's own aerodynamic wrench, motor noise and step of 10 ms. Single drones are integrated by scipy's Runge-Kutta
4(5) with RotorPy's tolerances; a batch by one fixed step of torchdiffeq's fourth-order Runge-Kutta, the cheapest
choice for a batch. No firmware, wind, contacts or sensors.
"""
# pyright: reportMissingImports=false

import argparse
import math
from typing import Any

import numpy as np
import torch
from rotorpy.vehicles.crazyflie_params import quad_params
from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams, Multirotor

from benchmarks.kernel.stopwatch import Flight, serve, single

STEP_S = 0.01
HOVER_RAD_S = math.sqrt(quad_params["mass"] * 9.81 / (4 * quad_params["k_eta"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--batch", action="store_true")
    parser.add_argument("--threads", action="store_true", help="use all cores")
    given = parser.parse_args()
    if not given.threads:
        single()
        torch.set_num_threads(1)  # rotorpy has imported torch before the pinning; two threads would wait for each other
    serve(batch if given.batch else objects)


def objects(count: int) -> Flight:
    vehicle = Multirotor(quad_params)
    states = [_state(k) for k in range(count)]
    command = {"cmd_motor_speeds": np.full(4, HOVER_RAD_S)}

    def advance() -> None:
        for k, state in enumerate(states):
            states[k] = vehicle.step(state, command, STEP_S)

    return Flight(advance, STEP_S)


def batch(count: int) -> Flight:
    device = torch.device("cpu")
    each = [_state(k) for k in range(count)]
    state: Any = {name: torch.from_numpy(np.stack([s[name] for s in each])) for name in each[0]}
    params = BatchedMultirotorParams([quad_params] * count, count, device)
    vehicle = BatchedMultirotor(params, count, state, device, integrator="rk4")
    command = {"cmd_motor_speeds": torch.full((count, 4), HOVER_RAD_S, dtype=torch.double)}

    def advance() -> None:
        nonlocal state
        state = vehicle.step(state, command, STEP_S)

    return Flight(advance, STEP_S)


def _state(k: int) -> dict[str, np.ndarray]:
    return {
        "x": np.array([4.0 * (k % 32), 4.0 * (k // 32), 1.0]),
        "v": np.zeros(3),
        "q": np.array([0.0, 0.0, 0.0, 1.0]),
        "w": np.zeros(3),
        "wind": np.zeros(3),
        "rotor_speeds": np.full(4, HOVER_RAD_S),
    }


if __name__ == "__main__":
    main()
