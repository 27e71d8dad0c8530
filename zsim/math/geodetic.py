"""Where points of W lie on the Earth, compiled; the way back is `zsim.math.frames.geodetic_to_enu`."""

import math

import numpy as np

from zsim.math.compiled import kernel
from zsim.math.frames import _E2, WGS84_A_M, WGS84_F, Array, enu_rows, geodetic_to_ecef

_B_M = WGS84_A_M * (1.0 - WGS84_F)
_CURVATURE_M = (WGS84_A_M**2 - _B_M**2) / _B_M
_STEPS = 4  # each gains a factor of about 300: 1e-15 rad after four for heights below 1000 km


def anchor(latitude_deg: float, longitude_deg: float, height_m: float) -> tuple[Array, Array]:
    """Return east, north, up of W as rows in Earth-fixed components, (3, 3), and W's origin there [m], (3,)."""
    return enu_rows(latitude_deg, longitude_deg), geodetic_to_ecef((latitude_deg, longitude_deg, height_m))


@kernel()
def geodetic(position_m: Array, rows: Array, place_m: Array) -> Array:
    """Return WGS 84 latitude [deg], longitude [deg] and ellipsoidal height [m] of points in W.

    Bowring's iteration on the parametric latitude, exact to 1e-9 m for heights between -10 km and 1000 km (Bowring,
    Survey Review 23 (1976) 323-327).

    Args:
        position_m: p_W, (n, 3).
        rows, place_m: what `anchor` returns.
    """
    coordinates = np.empty(position_m.shape)
    for i in range(position_m.shape[0]):
        e, n, u = position_m[i]
        x = place_m[0] + (e * rows[0, 0] + n * rows[1, 0] + u * rows[2, 0])
        y = place_m[1] + (e * rows[0, 1] + n * rows[1, 1] + u * rows[2, 1])
        z = place_m[2] + (e * rows[0, 2] + n * rows[1, 2] + u * rows[2, 2])
        level = math.hypot(x, y)
        lat = math.atan2(z, level * (1.0 - _E2))
        for _ in range(_STEPS):
            parametric = math.atan2((1.0 - WGS84_F) * math.sin(lat), math.cos(lat))
            s, c = math.sin(parametric), math.cos(parametric)
            lat = math.atan2(z + _CURVATURE_M * s * s * s, level - _E2 * WGS84_A_M * c * c * c)
        s = math.sin(lat)
        coordinates[i, 0] = math.degrees(lat)
        coordinates[i, 1] = math.degrees(math.atan2(y, x))
        coordinates[i, 2] = level * math.cos(lat) + z * s - WGS84_A_M * math.sqrt(1.0 - _E2 * s * s)
    return coordinates
