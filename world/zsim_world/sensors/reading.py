"""From errorless values to a reading: what faults add, the errors of the channels, what a stuck sensor holds.

The rows are those of `zsim_world.sensors.sensor_set`; `n` numbers of a reading have an error of their own.
"""

import math

from numpy.typing import NDArray

from zsim.math.compiled import inlined, kernel
from zsim_world.sensors.sensor_set import ARMED, CHANNELS_MAX, CONFIG, FAULT, HOLDING


@inlined
def rounded(value: float, bias: float, white: float, quantum: float) -> float:
    """Return what the converter gives: value + bias + white, rounded to the quantum (0: none)."""
    x = value + bias + white
    return x if quantum == 0.0 else quantum * math.floor(x / quantum + 0.5)


@inlined
def add_errors(n: int, value: NDArray, config: NDArray, bias: NDArray, noise: NDArray, at: int) -> None:
    """Add the errors of n channels to a value, in place.

    `noise` has standard normal numbers from `at` on (sensor_set.noise_width); `bias` is the bias of each channel, and
    behind those of all its Gauss-Markov process.
    """
    if config[CONFIG.correlated] != 0.0:
        for k in range(n):
            state = CHANNELS_MAX + k
            bias[state] = config[CONFIG.decay + k] * bias[state] + config[CONFIG.kick + k] * noise[at + 2 * n + 1 + k]
            value[k] += bias[state]
    for k in range(n):
        bias[k] += config[CONFIG.walk + k] * noise[at + n + k]
        white = config[CONFIG.white + k] * noise[at + k]
        value[k] = rounded(value[k], bias[k], white, config[CONFIG.quantum + k])


@inlined
def displace(n: int, value: NDArray, fault: NDArray) -> None:
    """Add what a fault adds to the errorless values of a sensor, in place."""
    for k in range(n):
        value[k] += fault[FAULT.offset + k]


@inlined
def hold_reading(value: NDArray, fault: NDArray) -> None:
    """Keep a reading (6,) that is the first of a stuck sensor, or give the one kept, in place."""
    if fault[FAULT.hold] == ARMED:
        fault[FAULT.hold] = HOLDING
        for k in range(CHANNELS_MAX):
            fault[FAULT.held + k] = value[k]
    elif fault[FAULT.hold] == HOLDING:
        for k in range(CHANNELS_MAX):
            value[k] = fault[FAULT.held + k]


@kernel(makes_arrays=False)
def read(n: int, value: NDArray, config: NDArray, bias: NDArray, fault: NDArray, noise: NDArray) -> bool:
    """Turn the errorless values of a user's sensor into a reading, in place; return False if it is lost."""
    displace(n, value, fault)
    add_errors(n, value, config, bias, noise, 0)
    kept = noise[2 * n] >= config[CONFIG.drop]
    if kept:
        hold_reading(value, fault)
    return kept
