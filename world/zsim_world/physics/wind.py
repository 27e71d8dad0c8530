"""Wind: steady, and gusts of the Dryden longitudinal form on every axis, alike but not equal at each drone."""

import math

from numpy.typing import NDArray

from zsim.math.compiled import inlined
from zsim.math.rotation import Vector
from zsim_world.state.vehicle import Row

# Columns of the one row of wind parameters
STEADY, GUST, LENGTH, SPEED_MIN, CORRELATION = 0, 3, 4, 5, 6  # m/s (3), m/s, m, m/s, -
COLUMNS = 7


@inlined
def gust_decay(length_m: float, airspeed_m_s: float, speed_min_m_s: float, dt: float) -> float:
    """Return exp(-dt / tau) with the correlation time tau = L / max(airspeed, V0) of the Dryden form.

    MIL-HDBK-1797, longitudinal: S(w) = 2 sigma^2 tau / (1 + (tau w)^2), the spectrum of a first-order filter.
    """
    return math.exp(-dt * max(airspeed_m_s, speed_min_m_s) / length_m)


@inlined
def gust_noise(correlation: float, common: float, own: float) -> float:
    """Return a standard normal number that drones share to the given correlation."""
    return math.sqrt(correlation) * common + math.sqrt(1.0 - correlation) * own


@inlined
def blow(wind: Row, v_WB: Vector, gust: NDArray, common: Vector, own: Vector, dt: float) -> None:
    """Advance the gust (3,) [m/s] at one drone by dt in place, by the exact discretisation of the filter.

    Args:
        wind: the wind's parameters (COLUMNS,); for many drones best loaded, then its roots are drawn once.
        v_WB: the drone's velocity [m/s].
        common: standard normal numbers that all drones share; own: of this drone.
    """
    square = 0.0
    for k in range(3):
        relative = v_WB[k] - wind[STEADY + k] - gust[k]
        square += relative * relative
    decay = gust_decay(wind[LENGTH], math.sqrt(square), wind[SPEED_MIN], dt)
    fresh = wind[GUST] * math.sqrt(1.0 - decay * decay)
    share = wind[CORRELATION]
    for k in range(3):
        gust[k] = decay * gust[k] + fresh * gust_noise(share, common[k], own[k])
