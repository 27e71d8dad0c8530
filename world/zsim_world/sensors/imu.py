"""The equation of the IMU."""

from zsim.math.compiled import inlined
from zsim.math.rotation import add, cross, rotate_back
from zsim_world.sensors.exposure import BodyTruth, MountedSensor, Site, Values


@inlined
def imu(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return specific force [m/s^2] and body rate [rad/s] at the sensor, both in S.

    f_S = R_SB (R_BW (a_WB - g_W) + alpha × p_BS + w × (w × p_BS)),  w_S = R_SB w    (Titterton and Weston, ch. 3)
    """
    f = rotate_back(x.q_WB, (x.a_WB[0], x.a_WB[1], x.a_WB[2] + site.gravity))
    f = add(f, add(cross(x.alpha_B, s.p_BS), cross(x.w_WB_B, cross(x.w_WB_B, s.p_BS))))
    return rotate_back(s.q_BS, f), rotate_back(s.q_BS, x.w_WB_B)
