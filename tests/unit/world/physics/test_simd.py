"""Eight drones in one step give the same bits as each drone alone."""

from typing import Any

import numpy as np
import pytest

from zsim.math.compiled import inlined
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics import rigid_body as body
from zsim_world.physics import simd
from zsim_world.physics.fleet_arrays import STATE, PerRotor, four, put, vector
from zsim_world.physics.surfaces import drag_anchors

DT = 0.0025  # s
COUNT = 11  # a whole block of eight and part of another

# compiling for these tests alone takes a minute; tests/unit/world/fleet compares a drone of a block with one alone
pytestmark = [pytest.mark.xdist_group("simd"), pytest.mark.soak]


@inlined
def each(bodies, dt):
    """Integrate one drone after the other, always with the ground."""
    for i in range(bodies.state.shape[0]):
        row, state, anchor = bodies.vehicle[i], bodies.state[i], bodies.anchor[i]
        rotors, air, push = (
            PerRotor(bodies.rotors[i], 0, 1, bodies.each),
            vector(bodies.air[i], 0),
            vector(bodies.push[i], 0),
        )
        body.step(row, rotors, anchor, state, bodies.command[i], air, push, dt)
        drag_anchors(row, anchor, vector(state, STATE.p_WB), four(state, STATE.q_WB))


@inlined
def accelerate_each(bodies):
    """Store the accelerations of one drone after the other, always with the ground."""
    for i in range(bodies.state.shape[0]):
        row, state, anchor = bodies.vehicle[i], bodies.state[i], bodies.anchor[i]
        (p, v, q, w), each = body.pose(state), bodies.each
        rotors, speeds = PerRotor(bodies.rotors[i], 0, 1, each), PerRotor(state, STATE.size, 1, each)
        commands, air, push = (
            PerRotor(bodies.command[i], 0, 1, each),
            vector(bodies.air[i], 0),
            vector(bodies.push[i], 0),
        )
        a, alpha = body.accelerations(True, row, rotors, anchor, p, v, q, w, speeds, commands, None, air, push)
        put(bodies.accel[i], 0, a)
        put(bodies.accel[i], 3, alpha)


def bodies_in_motion(rng, height_m, count=COUNT):
    """Return tumbling drones of two kinds, some of which pass through the ground."""
    heavy: Any = {"mass_kg": 0.6, "arm_m": 0.25, "thrust_n_s2": 1.2e-5, "rotor_time_constant_s": 0.05}
    drones = [
        {"name": f"d{k}", "position_m": [2.0 * k, 0.0, height_m], **(heavy if k % 3 == 1 else {})} for k in range(count)
    ]
    bodies = Fleet(resolve({"name": "t", "duration_s": 1, "drones": drones})).bodies
    state = bodies.state
    state[:, STATE.v_WB : STATE.v_WB + 3] = rng.normal(0.0, 4.0, (count, 3))
    turned = rng.normal((1.0, 0.0, 0.0, 0.0), 0.4, (count, 4))
    state[:, STATE.q_WB : STATE.q_WB + 4] = turned / np.linalg.norm(turned, axis=1)[:, None]
    state[:, STATE.w_WB_B : STATE.w_WB_B + 3] = rng.normal(0.0, 2.0, (count, 3))
    state[:, STATE.size :], bodies.command[:] = rng.uniform(200.0, 500.0, (2, count, 4))
    bodies.air[:], bodies.push[:] = rng.normal(0.0, 1.0, (2, count, 3))
    return bodies


def copied(bodies):
    return type(bodies)(
        *(
            type(x)(*(y.copy() for y in x)) if hasattr(x, "_fields") else x if isinstance(x, tuple) else x.copy()
            for x in bodies
        )
    )


@pytest.mark.parametrize("count", [1, 8, COUNT])
@pytest.mark.parametrize("height_m", [0.0, 0.3, 0.8, 30.0])
def test_a_block_gives_the_same_bits_as_each_drone_alone(height_m, count):
    one = bodies_in_motion(np.random.default_rng(3), height_m, count)
    other, least_m = copied(one), np.inf
    simd.line_up(one)
    for _ in range(400):
        simd.move(one, DT)
        each(other, DT)
        np.testing.assert_array_equal(one.state, other.state)
        simd.accelerate(one)
        accelerate_each(other)
        np.testing.assert_array_equal(one.accel, other.accel)
        least_m = min(least_m, one.state[:, 2].min())
    assert np.isfinite(one.state).all()
    assert count == 1 or (least_m < 0.2) == (height_m < 30.0)
    low = one.state[:, 2] < 0.2
    np.testing.assert_array_equal(one.anchor[low], other.anchor[low])
