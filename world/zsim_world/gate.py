"""The kernel: one gate of all drones, a pure function of the arrays that it is given.

In every physics tick, in this order: the firmware (every 5 ms) reads the newest samples and commands the rotors; all
drones are integrated; gusts move on (every 5 ms); drones meet; sensors that are due sample the new state.
"""

import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

from numba import njit
from numpy.typing import NDArray

from zsim_world import firmware, observer, sensors
from zsim_world import rigid_body as body
from zsim_world import sensor_set as ss
from zsim_world.battery import drained, percent
from zsim_world.compiled import compiled
from zsim_world.encounter import encounters
from zsim_world.ground import drag_anchors
from zsim_world.rigid_body import four, put, put_four, vector
from zsim_world.rotation import Vector
from zsim_world.vehicle import GRAVITY
from zsim_world.wind import STEADY, blow

# Rows of `clock`: the present tick, physics ticks per 5 ms; then lengths in `times`
TICK, TICKS_PER_STEP = 0, 1
DT, SILENCE_HOVER, SILENCE_LAND = 0, 1, 2  # s
FIELD, ORIGIN_HEIGHT = 0, 3  # columns of `place`: magnetic field in W [uT] (3), height above sea level [m]
WIND_STREAM = 6  # after the six sensors
POSITION_MAX_M, RATE_MAX_RAD_S = 1e6, 1e4  # beyond, the integration has diverged


class Arrays(NamedTuple):
    """All that a fleet is. N drones; the columns are told where they are used."""

    clock: NDArray  # int64 (2,)
    times: NDArray  # (3,)
    place: NDArray  # (4,)
    wind: NDArray  # (wind.COLUMNS,)
    vehicle: NDArray  # (N, vehicle.COLUMNS)
    setting: NDArray  # (N, firmware.SETTING_COLUMNS)
    gain: NDArray  # (N, gains.COLUMNS)
    board: NDArray  # (N, observer.CALIBRATION)
    config: NDArray  # (N, 6, sensor_set.COLUMNS)
    schedule: NDArray  # int64 (N, 6, 4)
    setpoint: NDArray  # (N, firmware.SETPOINT_COLUMNS)
    set_tick: NDArray  # int64 (N,), when the setpoint was sent
    state: NDArray  # (N, rigid_body.COLUMNS)
    accel: NDArray  # (N, 6), acceleration in W and angular acceleration in B
    anchor: NDArray  # (N, 8, 2)
    command: NDArray  # (N, 4), rad/s
    energy: NDArray  # (N,), J
    memory: NDArray  # (N, firmware.MEMORY_COLUMNS)
    belief: NDArray  # (N, observer.COLUMNS)
    device: NDArray  # (N, observer.REGISTERS)
    bias: NDArray  # (N, 6, 6)
    gust: NDArray  # (N, 3), m/s
    air: NDArray  # (N, 3), m/s
    push: NDArray  # (N, 3), N
    touching: NDArray  # int8 (N, N)
    touched: NDArray  # int8 (N, N), contacts that began in this gate
    noise: NDArray  # (N + 1, all streams), standard normal numbers; the last row holds the wind common to all
    noise_at: NDArray  # int64 (7,), where each stream begins in a row
    cursor: NDArray  # int64 (N + 1, 7), rows used of each stream
    log_index: NDArray  # int64 (samples, 3): sensor, drone, tick
    log_value: NDArray  # (samples, 6)


@compiled
def _steer(w: Arrays) -> None:
    """Let the firmware of every drone see and act."""
    for i in range(w.state.shape[0]):
        memory, belief, row = w.memory[i], w.belief[i], w.vehicle[i]
        on_ground = firmware.stands(memory)
        observer.observe(belief, row, w.gain[i], w.device[i], w.board[i], on_ground)
        silence = (w.clock[TICK] - w.set_tick[i]) * w.times[DT]
        hover_s, land_s = w.times[SILENCE_HOVER], w.times[SILENCE_LAND]
        charge = percent(row, w.energy[i])
        u = firmware.control(memory, belief, row, w.setting[i], w.setpoint[i], silence, hover_s, land_s, charge)
        put_four(w.command[i], 0, u if charge > 0.0 else (0.0, 0.0, 0.0, 0.0))


@compiled
def _move(w: Arrays) -> None:
    """Integrate every drone over one tick."""
    for i in range(w.state.shape[0]):
        air, push, command = vector(w.air[i], 0), vector(w.push[i], 0), four(w.command[i], 0)
        row, state, anchor = w.vehicle[i], w.state[i], w.anchor[i]
        body.step(row, anchor, state, command, air, push, w.times[DT])
        drag_anchors(row, anchor, vector(state, body.POSITION), four(state, body.ATTITUDE))


@compiled
def _gusts(w: Arrays) -> None:
    at, count = w.noise_at[WIND_STREAM], w.gust.shape[0]
    first = at + 3 * w.cursor[count, WIND_STREAM]
    for i in range(count + 1):
        w.cursor[i, WIND_STREAM] += 1
    common, own = w.noise[count, first : first + 3], w.noise[:count, first : first + 3]
    blow(w.wind, w.state, w.gust, common, own, observer.STEP_S)


@compiled
def _drain(w: Arrays) -> None:
    for i in range(w.state.shape[0]):
        w.energy[i] = drained(w.vehicle[i], w.energy[i], four(w.state[i], body.ROTOR), observer.STEP_S)


@compiled
def _meet(w: Arrays) -> float:
    """Set air and pushes for the next tick; return the least distance of two drones [m]."""
    for i in range(w.air.shape[0]):
        for k in range(3):
            w.air[i, k] = w.wind[STEADY + k] + w.gust[i, k]
    return encounters(w.vehicle, w.state, w.air, w.push, w.touching, w.touched)


@compiled
def _accelerate(w: Arrays) -> None:
    """Note the accelerations of every drone in its present state."""
    for i in range(w.state.shape[0]):
        s, air, push = w.state[i], vector(w.air[i], 0), vector(w.push[i], 0)
        p, v, q, rate = body.pose(s)
        speed, command = four(s, body.ROTOR), four(w.command[i], 0)
        a, alpha = body.accelerations(w.vehicle[i], w.anchor[i], p, v, q, rate, speed, command, air, push)
        put(w.accel[i], 0, a)
        put(w.accel[i], 3, alpha)


@compiled
def _ideal(w: Arrays, i: int, s: int) -> tuple[Vector, Vector]:
    """Return the errorless values of sensor s of drone i; unused places are zero."""
    config = w.config[i, s]
    p, v, q, rate = body.pose(w.state[i])
    p_BS, q_BS = vector(config, ss.MOUNT), four(config, ss.TURN)
    none = (0.0, 0.0, 0.0)
    if s == ss.IMU:
        a, alpha = vector(w.accel[i], 0), vector(w.accel[i], 3)
        return sensors.imu(a, q, rate, alpha, w.vehicle[i, GRAVITY], p_BS, q_BS)
    if s == ss.GPS:
        return sensors.gps(p, v, q, rate, p_BS)
    if s == ss.MAG:
        return sensors.mag(q, q_BS, vector(w.place, FIELD)), none
    if s == ss.BARO:
        return (sensors.height(p, q, p_BS), 0.0, 0.0), none
    if s == ss.SONAR:
        distance, echo = sensors.sonar(p, q, p_BS, q_BS, config[ss.LIMIT_MAX])
        return (distance, 1.0 if echo else 0.0, 0.0), none
    velocity, quality = sensors.flow(v, q, rate, p_BS)
    return velocity, (quality, 0.0, 0.0)


@compiled
def _sample(w: Arrays, i: int, s: int, value: NDArray) -> bool:
    """Write a reading of sensor s of drone i into value (6,); return False if it is lost."""
    first, second = _ideal(w, i, s)
    put(value, 0, first)
    put(value, 3, second)
    n = ss.CHANNELS[s]
    at = w.noise_at[s] + w.cursor[i, s] * (2 * n + 1)
    w.cursor[i, s] += 1
    config = w.config[i, s]
    for k in range(n):
        w.bias[i, s, k] += config[ss.WALK + k] * w.noise[i, at + n + k]
        white = config[ss.WHITE + k] * w.noise[i, at + k]
        value[k] = sensors.reading(value[k], w.bias[i, s, k], white, config[ss.QUANTUM + k])
    if s == ss.SONAR:
        value[0] = max(value[0], 0.0)
        if not config[ss.LIMIT_MIN] <= value[0] <= config[ss.LIMIT_MAX]:
            value[1] = 0.0
    elif s == ss.BARO:
        value[1] = value[0]
        value[0] = sensors.pressure(w.place[ORIGIN_HEIGHT] + value[1])
    return w.noise[i, at + 2 * n] >= config[ss.DROP]


@compiled
def _register(device: NDArray, s: int, value: NDArray) -> None:
    """Hand a sample to the firmware."""
    if s == ss.IMU:
        device[observer.ACCEL : observer.ACCEL + 6] = value
    elif s == ss.MAG:
        device[observer.MAG : observer.MAG + 3] = value[:3]
        device[observer.NEW_MAG] = 1.0
    elif s == ss.BARO:
        device[observer.BARO], device[observer.NEW_BARO] = value[1], 1.0
    elif s == ss.SONAR:
        device[observer.SONAR : observer.SONAR + 2] = value[:2]
        device[observer.NEW_SONAR] = 1.0
    elif s == ss.FLOW:
        device[observer.FLOW : observer.FLOW + 4] = value[:4]
        device[observer.NEW_FLOW] = 1.0


@compiled
def _sense(w: Arrays, step: bool, logged: int) -> int:
    """Let all sensors sample what is due at this tick; return the length of the log.

    The IMU samples in every step of the board, and what is due of it is published.
    """
    tick = w.clock[TICK]
    if step:
        _accelerate(w)
    for i in range(w.state.shape[0]):
        for s in range(len(ss.CHANNELS)):
            while step if s == ss.IMU else w.schedule[i, s, ss.DUE] <= tick:
                value = w.log_value[logged]
                kept = _sample(w, i, s, value)
                if kept:
                    _register(w.device[i], s, value)
                if _due(w.schedule[i, s], tick) and kept:
                    w.log_index[logged, 0], w.log_index[logged, 1], w.log_index[logged, 2] = s, i, tick
                    logged += 1
                if s == ss.IMU:
                    break
    return logged


@compiled
def _due(plan: NDArray, tick: int) -> bool:
    """Return whether a sample is due, and plan the next one if so."""
    if plan[ss.DUE] > tick:
        return False
    plan[ss.COUNT] += 1
    plan[ss.DUE] = (plan[ss.COUNT] * plan[ss.NUMERATOR] + plan[ss.DENOMINATOR] - 1) // plan[ss.DENOMINATOR]
    return True


@compiled
def _diverged(w: Arrays) -> int:
    """Return the first drone whose state is no longer one, or -1."""
    for i in range(w.state.shape[0]):
        size = 0.0
        for k in range(body.COLUMNS):
            size += abs(w.state[i, k])
        far = abs(w.state[i, 0]) + abs(w.state[i, 1]) + abs(w.state[i, 2])
        spin = abs(w.state[i, body.RATE]) + abs(w.state[i, body.RATE + 1]) + abs(w.state[i, body.RATE + 2])
        if not (math.isfinite(size) and far < POSITION_MAX_M and spin < RATE_MAX_RAD_S):
            return i
    return -1


def _sources_digest() -> int:
    """Return a number that changes with the text of any file compiled into the kernel."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return int.from_bytes(digest.digest()[:6], "little")


def _build(sources: int) -> Any:
    """Return the compiled kernel. numba's cache knows this file only: `sources` ties it to the others as well."""

    @njit(error_model="numpy", fastmath=False, cache=True)
    def advance(w: Arrays, ticks: int) -> tuple[int, float, int]:
        """Integrate so many physics ticks; 0 ticks: take the samples of the present instant.

        Returns:
            number of samples logged, least distance of two drones [m], diverged drone or -1.
        """
        logged, least = 0, math.inf if sources >= 0 else 0.0
        w.touched[:, :] = 0
        if ticks == 0:
            least = _meet(w)
            logged = _sense(w, True, logged)
        for _ in range(ticks):
            if w.clock[TICK] % w.clock[TICKS_PER_STEP] == 0:
                _steer(w)
            _move(w)
            w.clock[TICK] += 1
            step = w.clock[TICK] % w.clock[TICKS_PER_STEP] == 0
            if step:
                _gusts(w)
                _drain(w)
            least = min(least, _meet(w))
            logged = _sense(w, step, logged)
        return logged, least, _diverged(w)

    return advance


advance = _build(_sources_digest())
