"""The control law of a formation, from the estimated robots and a reference to velocity commands.

    c_dot_cmd = c_dot_des + k (c_des - c) + I,    I' = k_i (c_des - c),    r_dot = J^-1(c) c_dot_cmd

followed by a saturation that keeps the direction in cluster space (one factor for all robots) and by a
guard of the distance between robots.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from zsim_agents.cluster_space import Array, ClusterSpace

Pairs = tuple[tuple[int, int], ...]

GUARD_SWEEPS = 4  # passes over all pairs; one settles two robots, three robots in a corner need a few


@dataclass(frozen=True)
class FormationGains:
    """Parameters of the law; all are positive, validated with the scenario.

    Attributes:
        k_1_s: proportional gain [1/s]; 0.5 to 0.8 is good, unstable from about 2 on a drone's velocity loop.
        integral_1_s2: integral gain [1/s^2]; takes out the offset that wind leaves, 0 switches it off.
        integral_max_m_s, integral_max_rad_s: clamp of the integral term for lengths and for angles.
        speed_max_m_s, climb_max_m_s, yaw_rate_max_rad_s: limits of each robot.
        separation_min_m: least distance between two robots of a reference, and where the guard acts.
        separation_alarm_m: below it two robots are reported.
        guard_horizon_s: how far ahead the guard looks.
        response_s: lag of a drone's velocity loop, over which the guard expects it to keep its velocity.
    """

    k_1_s: float = 0.6
    integral_1_s2: float = 0.05
    integral_max_m_s: float = 0.5
    integral_max_rad_s: float = 0.1
    speed_max_m_s: float = 2.0  # limit of velocityXY in the paper's base simulator, hector_quadrotor
    climb_max_m_s: float = 1.0  # control_vz_max of the AR.Drone SDK outdoors, 1000 mm/s
    yaw_rate_max_rad_s: float = 1.75  # control_yaw of the AR.Drone SDK
    separation_min_m: float = 2.0  # four widths of the drone in its hull, 0.52 m
    separation_alarm_m: float = 1.5
    guard_horizon_s: float = 1.0
    response_s: float = 0.3


@dataclass(frozen=True, eq=False)
class FormationCommand:
    """What the law asks of the robots.

    Attributes:
        v_W: velocities (n, 3) [m/s, W]; yaw_rate: (n,) [rad/s].
        factor: the common factor of the saturation, 1 where nothing is saturated.
        guarded: pairs of robot indices that the guard holds apart.
        alarmed: pairs that are nearer than the alarm threshold.
    """

    v_W: Array
    yaw_rate: Array
    factor: float
    guarded: Pairs
    alarmed: Pairs


class FormationLaw:
    """The law above with its only state, the integral term (4n,) [m/s, rad/s]."""

    def __init__(self, space: ClusterSpace, gains: FormationGains | None = None) -> None:
        self.space = space
        self.gains = gains or FormationGains()
        self._clamp = np.where(space.in_radians, self.gains.integral_max_rad_s, self.gains.integral_max_m_s)
        self.reset()

    def reset(self) -> None:
        """Forget the integral term."""
        self.integral = np.zeros(self.space.size)

    def command(
        self, c: Array, p_W: Array, v_W: Array, c_des: Array, c_dot_des: Array, dt_s: float
    ) -> FormationCommand:
        """Return the command of this gate.

        Args:
            c: (4n,) cluster of the estimates; p_W, v_W: the estimates, (n, 3) [m, m/s; W].
            c_des, c_dot_des: (4n,) reference and its rate.
            dt_s: time since the last command, for the integral.
        """
        error = self.space.difference(c_des, c)
        c_dot = c_dot_des + self.gains.k_1_s * error + self.integral
        r_dot = (self.space.inverse_jacobian(c) @ c_dot).reshape(self.space.n, 4)
        factor = min(1.0, 1.0 / max(load(r_dot[:, :3], r_dot[:, 3], self.gains), 1e-9))
        r_dot *= factor
        v_cmd_W, guarded, alarmed = guard(p_W, v_W, r_dot[:, :3], self.gains)
        yaw_rate = r_dot[:, 3]
        if guarded:
            over = max(load(v_cmd_W, yaw_rate, self.gains), 1.0)
            v_cmd_W, yaw_rate = v_cmd_W / over, yaw_rate / over
        if factor == 1.0 and not guarded:
            self._integrate(error, dt_s)
        return FormationCommand(v_cmd_W, yaw_rate, factor, guarded, alarmed)

    def _integrate(self, error: Array, dt_s: float) -> None:
        """Advance the integral; it runs only while the robots follow the law, and never past its clamp."""
        grown = self.integral + self.gains.integral_1_s2 * dt_s * error
        self.integral = np.minimum(np.maximum(grown, -self._clamp), self._clamp)


def load(v_W: Array, yaw_rate: Array, gains: FormationGains) -> float:
    """Return the greatest ratio of a robot's speed, climb or yaw rate to its limit; 1 is at the limit."""
    most = 0.0
    for vx, vy, vz in v_W.tolist():
        most = max(most, math.hypot(vx, vy) / gains.speed_max_m_s, abs(vz) / gains.climb_max_m_s)
    return max(most, max(map(abs, yaw_rate.tolist())) / gains.yaw_rate_max_rad_s)


def guard(p_W: Array, v_W: Array, v_cmd_W: Array, gains: FormationGains) -> tuple[Array, Pairs, Pairs]:
    """Return the velocities with dangerous approaches taken out, the pairs concerned, and the pairs in alarm.

    Two robots at distance d, d' = rate of the command along their line, are held to
    d' >= -(d_near - separation_min) / guard_horizon: the distance predicted over the horizon stays above the
    minimum, and below it the approach is reversed. d_near allows for the velocities that the robots have,
    which last for their response time. Each robot of a pair takes half of the change;
    a few sweeps settle several pairs.
    """
    points, velocities = p_W.tolist(), v_W.tolist()
    n = len(points)
    risky = []
    alarmed = []
    fastest = 2 * math.hypot(gains.speed_max_m_s, gains.climb_max_m_s)
    reach = gains.separation_min_m + fastest * (gains.guard_horizon_s + gains.response_s)
    for j in range(1, n):
        for i in range(j):
            distance = math.dist(points[i], points[j])
            if distance >= reach:
                continue
            along = _direction(points[i], points[j], distance)
            approach = min(_along(along, velocities[i], velocities[j]), 0.0)
            near = distance + approach * gains.response_s
            risky.append((i, j, along, (gains.separation_min_m - near) / gains.guard_horizon_s))
            if distance < gains.separation_alarm_m:
                alarmed.append((i, j))
    commands = v_cmd_W.tolist()
    guarded = _part(commands, risky)
    return (np.array(commands) if guarded else v_cmd_W), guarded, tuple(alarmed)


def _part(commands: list[list[float]], risky: list[tuple[int, int, list[float], float]]) -> Pairs:
    """Change the commands in place until every pair separates at its least rate; return the pairs changed."""
    guarded: dict[tuple[int, int], None] = {}
    for _ in range(GUARD_SWEEPS):
        settled = True
        for i, j, along, least in risky:
            lacking = least - _along(along, commands[i], commands[j])
            if lacking <= 1e-9:
                continue
            settled = False
            guarded[i, j] = None
            for axis in range(3):
                commands[i][axis] -= along[axis] * lacking / 2
                commands[j][axis] += along[axis] * lacking / 2
        if settled:
            break
    return tuple(guarded)


def _along(along: list[float], v_i: list[float], v_j: list[float]) -> float:
    """Return the rate at which j leaves i along their line [m/s]."""
    return along[0] * (v_j[0] - v_i[0]) + along[1] * (v_j[1] - v_i[1]) + along[2] * (v_j[2] - v_i[2])


def _direction(a: list[float], b: list[float], distance: float) -> list[float]:
    """Return the unit vector from a to b; east where they coincide, so that they part at all."""
    if distance < 1e-6:
        return [1.0, 0.0, 0.0]
    return [(b[axis] - a[axis]) / distance for axis in range(3)]
