"""The equation of the optical flow."""

import math

from zsim.math.compiled import inlined
from zsim.math.rotation import heading, z_axis
from zsim_world.sensors.exposure import BodyTruth, MountedSensor, Site, Values, sensor_velocity


@inlined
def flow(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the sensor's velocity [m/s] in the heading frame, and the quality in [0, 1].

    Heading frame: x forward and y left in the horizontal plane, z up. The quality is the cosine of the tilt: how much
    of the picture is ground.
    """
    v = sensor_velocity(x, s)
    psi = heading(x.q_WB)
    cos, sin = math.cos(psi), math.sin(psi)
    quality = max(z_axis(x.q_WB)[2], 0.0)
    return (cos * v[0] + sin * v[1], cos * v[1] - sin * v[0], v[2]), (quality, 0.0, 0.0)
