"""The equation of the sonar."""

from zsim.math.compiled import inlined
from zsim.math.rotation import rotate, z_axis
from zsim_world.sensors.exposure import NONE, BodyTruth, MountedSensor, Site, Values, sensor_height

SONAR_COSINE_MIN = 0.5  # an echo comes back up to 60 deg from the vertical; beyond, it is scattered away


@inlined
def sonar(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the distance [m] to the ground along -z of the sensor, and 1 where there is an echo.

    Without an echo (beyond range_max, or the beam too far from the vertical) the distance is range_max.
    """
    upright = rotate(x.q_WB, z_axis(s.q_BS))[2]  # cosine between beam and vertical
    if upright < SONAR_COSINE_MIN:
        return (s.range_max, 0.0, 0.0), NONE
    distance = max(sensor_height(x, s), 0.0) / upright
    return (min(distance, s.range_max), 1.0 if distance <= s.range_max else 0.0, 0.0), NONE
