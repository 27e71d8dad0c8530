"""The equation of the magnetometer."""

from zsim.math.compiled import inlined
from zsim.math.rotation import rotate_back
from zsim_world.sensors.exposure import NONE, BodyTruth, MountedSensor, Site, Values


@inlined
def mag(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the Earth's field in S [uT]."""
    return rotate_back(s.q_BS, rotate_back(x.q_WB, site.field_W)), NONE
