"""The kernel: advances all drones by one gate; it reads and writes nothing but its arrays.

In every physics tick, in this order: the firmware (every 5 ms) reads the newest samples and commands the rotors; the
drones are integrated, and the poses of external ones set; gusts advance and batteries drain (every 5 ms); contacts with
obstacles, surfaces and other drones, and downwash, are computed; incidents are detected (every 5 ms); the sensors that
are due sample the new state.
"""

import math

from numpy.typing import NDArray

from zsim.math.compiled import inlined, kernel
from zsim.math.held import Held
from zsim.math.rotation import norm
from zsim.scenario.surroundings import Sheet
from zsim_world.fleet.flight_watch import watch
from zsim_world.physics import rigid_body as body
from zsim_world.physics.contacts import WIND, advance_gust, meet_drones
from zsim_world.physics.fleet_arrays import (
    CLOCK,
    EXPOSED,
    SPAN,
    STATE,
    STREAMS,
    Arrays,
    Bodies,
    NoiseRows,
    PerRotor,
    Senses,
    four,
    put,
    put_four,
    vector,
)
from zsim_world.physics.rays import Scene
from zsim_world.physics.rigid_body import drained
from zsim_world.physics.simd import accelerate, lead, line_up, move
from zsim_world.physics.surfaces import meet_obstacles, meet_surfaces
from zsim_world.sensors import sensor_set as ss
from zsim_world.sensors.sensor_set import (
    NEVER,
    SCHEDULE,
)
from zsim_world.vehicles import firmware
from zsim_world.vehicles.firmware import steer
from zsim_world.vehicles.observer import DEVICE, STEP_S

POSITION_MAX_M, RATE_MAX_RAD_S = 1e6, 1e4  # beyond these limits the integration has diverged


@inlined
def _drain(bodies: Bodies) -> None:
    for i in range(bodies.state.shape[0]):
        speeds = PerRotor(bodies.state[i], STATE.size, 1, bodies.each)
        bodies.energy[i] = drained(bodies.vehicle[i], bodies.energy[i], speeds, STEP_S)


@inlined
def _gusts(wind: NDArray, gust: NDArray, state: NDArray, noise: NoiseRows) -> None:
    count = gust.shape[0]
    at = noise.at[STREAMS.wind] + 3 * noise.cursor[count, STREAMS.wind]
    common, wind_row = vector(noise.table[count], at), vector(wind, 0) + four(wind, 3)
    for i in range(count):
        advance_gust(wind_row, vector(state[i], STATE.v_WB), gust[i], common, vector(noise.table[i], at), STEP_S)
    for i in range(count + 1):
        noise.cursor[i, STREAMS.wind] += 1


@inlined
def _meet(wind: NDArray, gust: NDArray, bodies: Bodies, sheet: Sheet) -> float:
    """Set air velocities and contact forces for the next tick; return the smallest distance between two drones [m]."""
    for i in range(gust.shape[0]):
        bodies.braced[i] = 0
        for k in range(3):
            bodies.air[i, k] = wind[WIND.steady + k] + gust[i, k]
            bodies.push[i, k] = 0.0
    if bodies.obstacle.shape[0] > 0:
        meet_obstacles(bodies)
    if bodies.plane.shape[1] > 0:
        meet_surfaces(bodies, sheet)
    return meet_drones(bodies)


@inlined
def _register(device: NDArray, s: int, value: NDArray) -> None:
    if s == ss.IMU:
        put(device, DEVICE.accel, vector(value, 0))
        put(device, DEVICE.gyro, vector(value, 3))
    elif s == ss.MAG:
        put(device, DEVICE.mag, vector(value, 0))
        device[DEVICE.new_mag] = 1.0
    elif s == ss.BARO:
        device[DEVICE.baro], device[DEVICE.new_baro] = value[1], 1.0
    elif s == ss.SONAR:
        device[DEVICE.sonar], device[DEVICE.sonar_valid] = value[0], value[1]
        device[DEVICE.new_sonar] = 1.0
    elif s == ss.FLOW:
        put_four(device, DEVICE.flow, four(value, 0))
        device[DEVICE.new_flow] = 1.0


@inlined
def _due(plan: NDArray, tick: int) -> bool:
    """Return whether a sample is due, and schedule the next one if so."""
    if plan[SCHEDULE.due] > tick:
        return False
    plan[SCHEDULE.count] += 1
    denominator = plan[SCHEDULE.denominator]
    plan[SCHEDULE.due] = (plan[SCHEDULE.count] * plan[SCHEDULE.numerator] + denominator - 1) // denominator
    return True


@inlined
def _sense(
    tick: int, step: bool, logged: int, bodies: Bodies, device: NDArray, noise: NoiseRows, senses: Senses, scene: Scene
) -> int:
    """Take all samples that are due at this tick; return the length of the log.

    The IMU samples in every step of the firmware; only the samples that are due are published.
    """
    for i in range(bodies.state.shape[0]):
        if step:
            logged = _take(ss.IMU, i, tick, logged, bodies, device[i], noise, senses, scene)
        if senses.soonest[i] <= tick:
            senses.soonest[i] = NEVER
            for s in range(ss.IMU + 1, len(ss.CHANNELS)):
                while senses.schedule[i, s, SCHEDULE.due] <= tick:
                    logged = _take(s, i, tick, logged, bodies, device[i], noise, senses, scene)
                senses.soonest[i] = min(senses.soonest[i], senses.schedule[i, s, SCHEDULE.due])
            for s in range(len(ss.CHANNELS), senses.schedule.shape[1]):
                while _due(senses.schedule[i, s], tick):
                    _expose(s, i, tick, bodies, senses)
                senses.soonest[i] = min(senses.soonest[i], senses.schedule[i, s, SCHEDULE.due])
    return logged


@inlined
def _expose(s: int, i: int, tick: int, bodies: Bodies, senses: Senses) -> None:
    """Log the truth for a user's sensor, whose equation is applied after the gate."""
    count = senses.exposed_count[0]
    row = senses.exposed[count]
    _note(senses.exposed_whose[count], s, i, tick)
    for k in range(STATE.size):
        row[EXPOSED.state + k] = bodies.state[i, k]
    for k in range(6):
        row[EXPOSED.accel + k] = bodies.accel[i, k]
    for k in range(3):
        row[EXPOSED.air + k] = bodies.air[i, k]
    senses.exposed_count[0] += 1


@inlined
def _take(
    s: int,
    i: int,
    tick: int,
    logged: int,
    bodies: Bodies,
    device: NDArray,
    noise: NoiseRows,
    senses: Senses,
    scene: Scene,
) -> int:
    """Sample sensor s of drone i for the firmware and, if due, for the log; return the length of the log."""
    value = senses.value[logged]
    is_received = ss.sample(s, i, bodies, noise, senses, scene, value)
    if is_received:
        _register(device, s, value)
    if _due(senses.schedule[i, s], tick) and is_received:
        _note(senses.whose[logged], s, i, tick)
        logged += 1
    return logged


@inlined
def _note(row: NDArray, s: int, i: int, tick: int) -> None:
    row[0], row[1], row[2] = s, i, tick


@inlined
def _diverged(state: NDArray) -> int:
    """Return the first drone whose state is not finite or is out of bounds; -1 if none is."""
    for i in range(state.shape[0]):
        total = 0.0
        for k in range(state.shape[1]):
            total += abs(state[i, k])
        p, _, _, rate = body.pose(state[i])
        if not (math.isfinite(total) and norm(p) < POSITION_MAX_M and norm(rate) < RATE_MAX_RAD_S):
            return i
    return -1


@kernel(makes_arrays=False)
def enter(memory: NDArray, belief: NDArray, mode: int) -> None:
    """Set the mode of a drone's firmware, given its rows of `boards`."""
    firmware.enter(memory, belief, mode)


@kernel()
def advance(held: Held, ticks: int) -> tuple[int, float, int, bool]:
    """Integrate physics ticks; with 0 ticks, only take the samples of the present instant.

    Args:
        held: the fleet's `Arrays`, wrapped by `zsim.math.held.hold`.

    Returns:
        number of samples logged (without those of users' sensors), smallest distance between two drones [m], index of a
            diverged drone or -1, whether there was an incident.
    """
    return _advance(held.content, ticks)


@inlined
def _advance(w: Arrays, ticks: int) -> tuple[int, float, int, bool]:
    time, bodies, boards, noise, senses, wind, gust, watched, scene, sheet = w
    clock, device = time.clock, boards.device
    logged, min_distance = 0, math.inf
    bodies.touched.fill(0)
    bodies.bumped.fill(0)
    watched.found.fill(0)
    senses.exposed_count[0] = 0
    line_up(bodies)
    for _ in range(max(ticks, 1)):
        if ticks > 0:
            if clock[CLOCK.tick] % clock[CLOCK.ticks_per_step] == 0:
                steer(time, bodies, boards)
            move(bodies, time.spans[SPAN.dt])
            lead(bodies, time.spans[SPAN.dt])
            clock[CLOCK.tick] += 1
        step = ticks == 0 or clock[CLOCK.tick] % clock[CLOCK.ticks_per_step] == 0
        if step and ticks > 0:
            _gusts(wind, gust, bodies.state, noise)
            _drain(bodies)
        min_distance = min(min_distance, _meet(wind, gust, bodies, sheet))
        if step:
            accelerate(bodies)
            if ticks > 0:
                watch(bodies, boards.memory, watched, clock[CLOCK.tick] // clock[CLOCK.ticks_per_step])
        logged = _sense(clock[CLOCK.tick], step, logged, bodies, device, noise, senses, scene)
    incidents = 0
    for i in range(watched.found.size):
        incidents |= watched.found[i]
    return logged, min_distance, _diverged(bodies.state), incidents != 0
