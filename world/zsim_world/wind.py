"""Wind: steady, and gusts of the Dryden longitudinal form on every axis, alike but not equal at each drone."""

import math

from zsim_world.compiled import compiled
from numpy.typing import NDArray

from zsim_world.rigid_body import VELOCITY

# Columns of the one row of wind parameters
STEADY, GUST, LENGTH, SPEED_MIN, CORRELATION = 0, 3, 4, 5, 6  # m/s (3), m/s, m, m/s, -
COLUMNS = 7


@compiled
def gust_decay(length_m: float, airspeed_m_s: float, speed_min_m_s: float, dt: float) -> float:
    """Return exp(-dt / tau) with the correlation time tau = L / max(airspeed, V0) of the Dryden form.

    MIL-HDBK-1797, longitudinal: S(w) = 2 sigma^2 tau / (1 + (tau w)^2), the spectrum of a first-order filter.
    """
    return math.exp(-dt * max(airspeed_m_s, speed_min_m_s) / length_m)


@compiled
def gust_noise(correlation: float, common: float, own: float) -> float:
    """Return a standard normal number that two drones share to the given correlation."""
    return math.sqrt(correlation) * common + math.sqrt(1.0 - correlation) * own


@compiled
def blow(wind: NDArray, state: NDArray, gust: NDArray, common: NDArray, own: NDArray, dt: float) -> None:
    """Advance the gusts (N, 3) [m/s] by dt in place, by the exact discretisation of the filter.

    Args:
        wind: the wind's parameters (COLUMNS,).
        state: the drones' states.
        common: (3,) standard normal numbers for all; own: (N, 3) for each drone.
    """
    for i in range(gust.shape[0]):
        square = 0.0
        for k in range(3):
            relative = state[i, VELOCITY + k] - wind[STEADY + k] - gust[i, k]
            square += relative * relative
        decay = gust_decay(wind[LENGTH], math.sqrt(square), wind[SPEED_MIN], dt)
        fresh = wind[GUST] * math.sqrt(1.0 - decay * decay)
        for k in range(3):
            gust[i, k] = decay * gust[i, k] + fresh * gust_noise(wind[CORRELATION], common[k], own[i, k])
