"""The equation of the GPS."""

from zsim.math.compiled import inlined
from zsim.math.rotation import add, rotate
from zsim_world.sensors.exposure import BodyTruth, MountedSensor, Site, Values, sensor_velocity


@inlined
def gps(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return position [m] and velocity [m/s] of the antenna in W."""
    return add(x.p_WB, rotate(x.q_WB, s.p_BS)), sensor_velocity(x, s)
