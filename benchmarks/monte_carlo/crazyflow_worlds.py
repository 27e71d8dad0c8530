"""crazyflow: worlds of three Crazyflies as one batch, each drone's mass drawn anew for each flight.

Position controller (crazyflow's Mellinger) at 50 Hz, attitude and thrust control at 400 Hz, first-principles rotors and
body by Euler's method at 400 Hz, single precision. A flight of all worlds, or its first `--seconds`, is one compiled
loop that also computes the results and never returns to Python. No sensors, estimators, wind or contacts.
"""
# pyright: reportMissingImports=false

import argparse
import os
from contextlib import chdir
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.kernel.crazyflow_jax import RATE_HZ, simulator
from benchmarks.monte_carlo.way import Way
from benchmarks.monte_carlo.worker import Flown, Fly, serve

GATE_HZ = 50
MASS_STD = 0.01  # relative to the mass; design choice, so that flights differ


def main() -> None:
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    serve(build, worlds=64, seconds=330.0)


def build(way: Way, given: argparse.Namespace) -> Fly:
    """Return a function that flies all worlds, starting where the drones of Test 1 stand."""
    import jax
    from crazyflow.control import Control
    from crazyflow.sim.integration import Integrator

    worlds = given.worlds
    with TemporaryDirectory() as folder, chdir(folder):  # MuJoCo logs its warnings to a file in the working directory
        sim = simulator(worlds, 3, state_freq=GATE_HZ, control=Control.state, integrator=Integrator.euler)
    gates = min(round(given.seconds * GATE_HZ), len(way.p_W) - 1)
    commands = jax.numpy.asarray(_commands(way)[:gates], dtype=jax.numpy.float32)
    start: Any = sim.data.replace(states=_standing(sim.data.states, commands[0]))
    fly = _loop(sim.build_step_fn(), commands, worlds)

    def flown(seed: int) -> Flown:
        drawn = jax.random.normal(jax.random.key(seed + 1000 * given.worker), (worlds, 3, 1))
        mass = start.params.mass * (1.0 + MASS_STD * drawn)
        squares, closest = jax.block_until_ready(fly(start.replace(params=start.params.replace(mass=mass))))
        flights = worlds * gates / (len(way.p_W) - 1)
        return Flown(flights, float(np.sqrt(np.mean(squares))), float(np.min(closest)))

    return flown


def _loop(step: Any, commands: Any, worlds: int) -> Any:
    """Return a compiled flight along `commands` that gives every world's mean square error and closest approach."""
    import jax
    import jax.numpy as jnp
    from crazyflow.sim import functional

    def gate(carry: Any, command: Any) -> tuple[Any, None]:
        data, squares, closest = carry
        data = functional.state_control(data, jnp.broadcast_to(command, (worlds, 3, 16)))
        data = step(data, n_steps=RATE_HZ // GATE_HZ)
        p_W = data.states.pos
        squares += jnp.sum((p_W - command[:, :3]) ** 2, axis=(1, 2))
        apart = jnp.linalg.norm(p_W - jnp.roll(p_W, 1, axis=1), axis=-1)
        return (data, squares, jnp.minimum(closest, apart.min(axis=1))), None

    @jax.jit
    def fly(data: Any) -> Any:
        none = jnp.zeros(worlds), jnp.full(worlds, jnp.inf)
        (_, squares, closest), _ = jax.lax.scan(gate, (data, *none), commands)
        return squares / (3 * len(commands)), closest

    return fly


def _commands(way: Way) -> np.ndarray:
    """Return position, velocity, acceleration, attitude (x, y, z, w) and rates at the end of every gate, (K, 3, 16)."""
    found = np.zeros((len(way.p_W) - 1, 3, 16))
    found[..., 0:3], found[..., 3:6] = way.p_W[1:], way.v_W[1:]
    found[..., 11], found[..., 12] = np.sin(way.yaw[1:] / 2), np.cos(way.yaw[1:] / 2)
    return found


def _standing(states: Any, command: Any) -> Any:
    """Return `states` with all drones at rest, posed as in `command`."""
    return states.replace(pos=states.pos.at[:].set(command[:, :3]), quat=states.quat.at[:].set(command[:, 9:13]))


if __name__ == "__main__":
    main()
