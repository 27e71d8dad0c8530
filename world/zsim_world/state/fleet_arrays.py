"""The arrays that a fleet is made of: what the kernel reads and writes. N drones, a row each.

The columns are told where they are used: vehicle.py, rigid_body.py, firmware.py, observer.py, gains.py, sensor_set.py.
"""

from typing import NamedTuple

from numpy.typing import NDArray

TICK, TICKS_PER_STEP = 0, 1  # of `clock`: present physics tick, ticks per 5 ms
DT, SILENCE_HOVER, SILENCE_LAND = 0, 1, 2  # of `spans`: physics tick, firmware's patience [s]
FIELD, ORIGIN_HEIGHT = 0, 3  # columns of `place`: magnetic field in W [uT] (3), height above sea level [m]


class Time(NamedTuple):
    clock: NDArray  # int64 (2,), as above
    spans: NDArray  # (3,), s, as above


class Near(NamedTuple):
    """Pairs of drones that can matter to each other, and for which places that was found (encounter.py)."""

    pair: NDArray  # int32 (N (N - 1) / 2, 2), i < j, ascending
    noted: NDArray  # int64 (1,), how many pairs
    origin: NDArray  # (N, 3), m


class Bodies(NamedTuple):
    """N aircraft, as physics has them."""

    vehicle: NDArray  # (N, vehicle.COLUMNS)
    state: NDArray  # (N, rigid_body.COLUMNS)
    accel: NDArray  # (N, 6), acceleration in W and angular acceleration in B
    anchor: NDArray  # (N, 8, 2), m
    command: NDArray  # (N, 4), rad/s
    energy: NDArray  # (N,), J
    air: NDArray  # (N, 3), m/s
    push: NDArray  # (N, 3), N
    touching: NDArray  # int8 (N, N)
    touched: NDArray  # int8 (N, N), contacts that began in this gate
    near: Near
    obstacle: NDArray  # (M, obstacle.COLUMNS)
    bumping: NDArray  # int8 (N, M), whose hull touches which obstacle
    bumped: NDArray  # int8 (N, M), contacts that began in this gate
    lanes: NDArray  # (blocks, block.LANES * lanes.COLUMNS), where they are side by side


class Boards(NamedTuple):
    """N navigation boards with their firmware."""

    setting: NDArray  # (N, firmware.SETTING_COLUMNS)
    gain: NDArray  # (N, gains.COLUMNS)
    calibration: NDArray  # (N, observer.CALIBRATION)
    setpoint: NDArray  # (N, firmware.SETPOINT_COLUMNS)
    set_tick: NDArray  # int64 (N,), when the setpoint was sent
    memory: NDArray  # (N, firmware.MEMORY_COLUMNS)
    belief: NDArray  # (N, observer.COLUMNS)
    actuator: NDArray  # (N, steering.ACTUATOR_COLUMNS), what faults make of the commands to the rotors
    device: NDArray  # (N, observer.REGISTERS)
    lanes: NDArray  # (blocks, block.LANES * steering.COLUMNS), where they are side by side


class Noise(NamedTuple):
    """Standard normal numbers, a row per drone; the last row holds the wind that all share."""

    table: NDArray  # (N + 1, all streams)
    at: NDArray  # int64 (7,), where each stream begins in a row
    cursor: NDArray  # int64 (N + 1, 7), how much of each stream is used


class Senses(NamedTuple):
    """N sets of six sensors, and the log of what they sampled in a gate."""

    place: NDArray  # (4,), as above
    config: NDArray  # (N, 6, sensor_set.COLUMNS)
    fault: NDArray  # (N, 6, sensor_set.FAULT_COLUMNS)
    schedule: NDArray  # int64 (N, 6, 4)
    soonest: NDArray  # int64 (N,), tick at which one of the sensors but the IMU falls due
    bias: NDArray  # (N, 6, 6)
    whose: NDArray  # int64 (samples, 3): sensor, drone, tick
    value: NDArray  # (samples, 6)


class Arrays(NamedTuple):
    """All that a fleet is."""

    time: Time
    bodies: Bodies
    boards: Boards
    noise: Noise
    senses: Senses
    wind: NDArray  # (wind.COLUMNS,)
    gust: NDArray  # (N, 3), m/s
