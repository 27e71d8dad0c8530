"""crazyflow on JAX's CPU backend: first-principles rotors and body, attitude controller; no sensors, wind or contacts.

Steps at 400 Hz, like zsim's physics, by Euler's method (crazyflow's default) or fourth-order Runge-Kutta (`--rk4`). A
call simulates 20 ms, as one command per gate requires, or a second (`--long`). Measured compiled and warm.
"""
# pyright: reportMissingImports=false

import argparse
import os
from typing import Any

from benchmarks.kernel.stopwatch import Flight, serve, single

RATE_HZ = 400
TOGETHER_MAX = (
    100  # maximum number of drones in one world; 1000 take two minutes to build, and run as fast in 1000 worlds
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rk4", action="store_true")
    parser.add_argument("--long", action="store_true", help="simulate a second per call")
    parser.add_argument("--threads", action="store_true", help="use all cores")
    given = parser.parse_args()
    os.environ["JAX_PLATFORMS"] = "cpu"
    if not given.threads:
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
        single()
    serve(lambda count: flight(count, given.rk4, RATE_HZ if given.long else RATE_HZ // 50))


def simulator(worlds: int, drones: int, **options: Any) -> Any:
    """Return a simulator of drones at rest, with body, rotors and attitude controller stepped at RATE_HZ."""
    from crazyflow.sim import Sim

    rates = dict.fromkeys(("freq", "attitude_freq", "body_rate_freq", "force_torque_freq"), RATE_HZ)
    sim = Sim(n_worlds=worlds, n_drones=drones, **rates, **options)
    sim.reset()
    return sim


def flight(count: int, rk4: bool, steps: int) -> Flight:
    import jax
    import numpy as np
    from crazyflow.control import Control
    from crazyflow.sim.integration import Integrator

    worlds, each = (1, count) if count <= TOGETHER_MAX else (count, 1)
    sim = simulator(worlds, each, control=Control.attitude, integrator=Integrator.rk4 if rk4 else Integrator.euler)
    command = np.zeros((worlds, each, 4), dtype=np.float32)
    command[..., 3] = float(np.ravel(sim.data.params.mass)[0]) * 9.81  # N

    def advance() -> None:
        sim.attitude_control(command)
        sim.step(steps)
        jax.block_until_ready(sim.data.states.pos)

    return Flight(advance, steps / RATE_HZ)


if __name__ == "__main__":
    main()
