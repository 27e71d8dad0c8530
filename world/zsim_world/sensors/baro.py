"""The equation of the barometer: a height with errors, and the pressure that it stands for."""

import math

from zsim.math.compiled import inlined
from zsim_world.sensors.exposure import NONE, BodyTruth, MountedSensor, Site, Values, sensor_height

SEA_LEVEL_PA = 101_325.0  # Pa, ISO 2533
LAPSE_1_M = 2.25577e-5  # 1/m, 0.0065 K/m over 288.15 K, ISO 2533
PRESSURE_EXPONENT = 5.25588  # g M / (R L), ISO 2533


@inlined
def baro(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the height of the sensor over the origin of W [m]."""
    return (sensor_height(x, s), 0.0, 0.0), NONE


@inlined
def pressure(altitude_m: float) -> float:
    """Return the static pressure [Pa] of the standard atmosphere at an altitude above sea level (ISO 2533).

    It holds to 11 km, which no scenario allows to exceed; a drone that a wind carries beyond finds the same law, and
    where that ends, at 44 km, a vacuum.
    """
    return SEA_LEVEL_PA * math.pow(max(1.0 - LAPSE_1_M * altitude_m, 0.0), PRESSURE_EXPONENT)
