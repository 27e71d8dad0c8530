"""The air: steady wind, gusts of the Dryden longitudinal form, correlated between drones, and downwash."""

import math

from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import Field, columns, inlined
from zsim.math.rotation import Vector
from zsim_world.physics.fleet_arrays import Row

WIND = columns(
    "WindColumns",
    (
        Field("steady", "m/s", 3),
        Field("gust", "m/s"),  # standard deviation per axis
        Field("length", "m"),
        Field("speed_min", "m/s"),
        Field("correlation", "1"),  # between drones
    ),
)
JET_SPREAD = 0.107  # growth of a round jet's 1/e width (Fischer et al., Mixing in Inland and Coastal Waters, 1979)
JET_WIDTHS = 3.0  # beyond three widths the jet is 1e-4 of its core


@inlined
def gust_decay(length_m: float, airspeed_m_s: float, speed_min_m_s: float, dt: float) -> float:
    """Return exp(-dt / tau) with the correlation time tau = L / max(airspeed, V0) of the Dryden form.

    MIL-HDBK-1797, longitudinal: S(w) = 2 sigma^2 tau / (1 + (tau w)^2), the spectrum of a first-order filter.
    """
    return el.exp(-dt * max(airspeed_m_s, speed_min_m_s) / length_m)


@inlined
def gust_noise(correlation: float, common: float, own: float) -> float:
    """Return a standard normal number with the given correlation between drones."""
    return math.sqrt(correlation) * common + math.sqrt(1.0 - correlation) * own


@inlined
def blow(wind: Row, v_WB: Vector, gust: NDArray, common: Vector, own: Vector, dt: float) -> None:
    """Advance the gust (3,) [m/s] at one drone by dt in place, by the exact discretisation of the filter.

    Args:
        wind: the wind's parameters (WIND.size,); load them once for many drones, so that roots are computed once.
        v_WB: the drone's velocity [m/s].
        common: standard normal numbers that all drones share; own: of this drone.
    """
    square = 0.0
    for k in range(3):
        relative = v_WB[k] - wind[WIND.steady + k] - gust[k]
        square += relative * relative
    decay = gust_decay(wind[WIND.length], math.sqrt(square), wind[WIND.speed_min], dt)
    fresh = wind[WIND.gust] * math.sqrt(1.0 - decay * decay)
    share = wind[WIND.correlation]
    for k in range(3):
        gust[k] = decay * gust[k] + fresh * gust_noise(share, common[k], own[k])


@inlined
def jet_reach(start_m: float, below_m: float) -> float:
    """Return the radius [m] of a jet, of this width at its start, so far below it."""
    return JET_WIDTHS * (start_m + JET_SPREAD * below_m)


@inlined
def downwash(thrust_n: float, density: float, start_m: float, below_m: float, aside_m: float) -> float:
    """Return the downward speed [m/s] of the air below a hovering drone.

    The far wake of momentum theory, 2 v_h = 2 sqrt(T / (2 rho A)), as a turbulent round jet that keeps its momentum:
    w = 2 v_h (b0 / b) exp(-(r / b)^2), b = b0 + 0.107 z, A = pi b0^2, b0 = sqrt(n) R for n rotors of radius R.

    Args:
        thrust_n: of the drone above; density: of the air [kg/m^3]; start_m: b0 of the drone above.
        below_m, aside_m: where, from the drone above, both >= 0.
    """
    width = start_m + JET_SPREAD * below_m
    if aside_m > JET_WIDTHS * width or thrust_n <= 0.0:
        return 0.0
    disc = math.pi * start_m * start_m
    core = 2.0 * math.sqrt(thrust_n / (2.0 * density * disc)) * start_m / width
    ratio = aside_m / width
    return core * el.exp(-ratio * ratio)
