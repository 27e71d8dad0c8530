"""Which hats a camera has in view, and where, from true poses without pictures. Compiled and deterministic.

A hat is a ball. It is in view if it is entirely within the picture and enough of its edge is visible, to which a
detector fits a circle. It can be hidden by obstacles, surfaces, hulls (flat bodies of revolution about their drones' z
axis) and, from below, by the rim of the drone's own rotors.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import Field, columns, inlined, kernel
from zsim.math.rotation import (
    Quaternion,
    Vector,
    add,
    attitude_between,
    axpy,
    cross,
    dot,
    norm,
    position_between,
    rotate,
    rotate_back,
    scaled,
    subtract,
)
from zsim.sensors.camera import Camera
from zsim.sensors.camera_model import Lens, camera_pose, lens_of, pixel, spread
from zsim_world.physics.fleet_arrays import STATE
from zsim_world.physics.rays import HULL_FLATNESS, Scene, cast_parts
from zsim_world.physics.rigid_body import four, vector

VIEW = columns(  # of a hat in a camera
    "ViewColumns",
    (
        Field("seen", "1"),  # 0 or 1
        Field("direction_K", "1", 3),  # unit vector to its centre
        Field("share", "1"),  # of its edge, that is visible
        Field("centre", "1"),  # errors of the centre of a circle through what is visible, over those of a whole one
        Field("radius", "1"),  # likewise of its radius
        Field("range", "m"),
        Field("angle", "rad"),  # its apparent diameter
        Field("scale", "px/rad"),  # of the picture where it is
        Field("rate", "rad/s"),  # at which it moves over the picture
    ),
)
CAMERA = columns(  # as mounted on a drone
    "CameraColumns", (Field("lens", "1, px", 11), Field("p_BK", "m", 3), Field("q_BK", "1", 4))
)
AHEAD_MIN = 0.05  # cosine to the axis; flatter rays never fall on a picture of 150 deg
RIM_WIDE, RIM_HIGH = 1.15, 0.14  # radius and height of the rotors' rim, in radii of a hull; fitted to pictures
POINTS = 32  # of its edge, that are looked at
COSINES, SINES = (np.array([f(2.0 * math.pi * k / POINTS) for k in range(POINTS)]) for f in (el.cos, el.sin))
LEVEL_COSINE = 0.9  # of a ray that is not nearly upright
SHARE_MIN = 0.3  # of its edge; of a ball with less in view a detector does not know the circle
EDGE_PX = 3.0  # px, nearer than which to the picture's edge a detector takes a hat for cut; the blur of its rim


class MountedCamera(NamedTuple):
    """A camera: lens, and pose in its drone's body."""

    lens: Lens
    p_BK: Vector  # m
    q_BK: Quaternion


def camera_row(camera: Camera) -> NDArray:
    """Return the row of a camera, (CAMERA.size,)."""
    pose = camera_pose(camera)
    return np.array([*lens_of(camera), *pose.p_BK.tolist(), *pose.q_BK], dtype=float)


@inlined
def mounted(row: NDArray) -> MountedCamera:
    """Return the camera of a row."""
    lens = Lens(
        row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], int(row[9]), int(row[10])
    )  # as Lens has them
    return MountedCamera(lens, vector(row, CAMERA.p_BK), four(row, CAMERA.q_BK))


@kernel()
def poses_between(former: NDArray, former_ns: int, now: NDArray, now_ns: int, t_ns: int) -> NDArray:
    """Return the poses of all drones at an instant between two gates, (N, STATE.size).

    Args:
        former, now: states at the gates, (N, STATE.size or more), between which the other columns are interpolated.
    """
    if t_ns >= now_ns or now_ns <= former_ns:
        return now.copy()
    s, dt = (t_ns - former_ns) / (now_ns - former_ns), (now_ns - former_ns) * 1e-9
    poses = former + s * (now - former)
    for i in range(len(poses)):
        a, b = former[i], now[i]
        p = position_between(
            s, dt, vector(a, STATE.p_WB), vector(a, STATE.v_WB), vector(b, STATE.p_WB), vector(b, STATE.v_WB)
        )
        q = attitude_between(s, four(a, STATE.q_WB), four(b, STATE.q_WB))
        for k in range(3):
            poses[i, STATE.p_WB + k] = p[k]
        for k in range(4):
            poses[i, STATE.q_WB + k] = q[k]
    return poses


@inlined
def _hull_hides(eye: Vector, ray: Vector, far: float, p_WB: Vector, q_WB: Quaternion, radius: float) -> bool:
    """Tell whether a hull is on a ray (unit vector, W) nearer than `far` [m]: an ellipsoid, scaled to a ball."""
    o, d = rotate_back(q_WB, subtract(eye, p_WB)), rotate_back(q_WB, ray)
    stretch = 1.0 / HULL_FLATNESS
    o, d = (o[0], o[1], stretch * o[2]), (d[0], d[1], stretch * d[2])
    a, b, c = dot(d, d), dot(o, d), dot(o, o) - radius * radius
    root = b * b - a * c
    if c <= 0.0 or root <= 0.0:
        return False  # the eye is inside of it, as that of its own camera, or the ray passes
    at = (-b - math.sqrt(root)) / a
    return 0.0 < at < far


@inlined
def _rim_hides(eye: Vector, ray: Vector, p_WB: Vector, q_WB: Quaternion, radius: float) -> bool:
    """Tell whether a ray to a drone's own hat passes upwards through the disc of its rotors."""
    o, d = rotate_back(q_WB, subtract(eye, p_WB)), rotate_back(q_WB, ray)
    rise = RIM_HIGH * radius - o[2]
    if rise <= 0.0 or d[2] <= 0.0:
        return False
    x, y = o[0] + rise / d[2] * d[0], o[1] + rise / d[2] * d[1]
    return x * x + y * y < RIM_WIDE * RIM_WIDE * radius * radius


@inlined
def _drone_hides(eye: Vector, ray: Vector, away: float, i: int, m: int, pose: NDArray, radius: float) -> bool:
    """Tell whether drone i is on a ray to a ball, the hat of drone m or of no drone."""
    p, q = vector(pose, STATE.p_WB), four(pose, STATE.q_WB)
    return _rim_hides(eye, ray, p, q, radius) if i == m else _hull_hides(eye, ray, away, p, q, radius)


@inlined
def _passes(eye: Vector, ray: Vector, away: float, p: Vector, radius: float) -> bool:
    """Tell whether a sphere is beside or behind all rays to a ball."""
    to = subtract(p, eye)
    along = min(max(dot(to, ray), 0.0), away)
    off = axpy(to, -along, ray)
    return dot(off, off) > radius * radius


@inlined
def _scale(lens: Lens, cosine: float) -> float:
    """Return pixels per radian off the axis: the mean of along and across the radius, f / cos^2 and f / cos."""
    return lens.fx / (cosine * math.sqrt(cosine))


@inlined
def _in_picture(lens: Lens, to_K: Vector, angle: float) -> bool:
    """Tell whether a ball of an apparent diameter [rad] is entirely within the picture."""
    cosine = to_K[2] / norm(to_K)
    if cosine < AHEAD_MIN:
        return False
    u, v = pixel(lens, to_K[0], to_K[1], to_K[2])
    edge = 0.5 * angle * _scale(lens, cosine) + EDGE_PX - 0.5
    return edge <= u < lens.width - 1.0 - edge and edge <= v < lens.height - 1.0 - edge


@inlined
def _hidden(
    eye: Vector, ray: Vector, away: float, ball: float, own: int, m: int, poses: NDArray, hulls: NDArray, scene: Scene
) -> int:
    """Return the hidden points of a ball's edge, one bit each."""
    e1 = (ray[1], -ray[0], 0.0) if abs(ray[2]) < LEVEL_COSINE else (0.0, ray[2], -ray[1])
    e1 = scaled(e1, 1.0 / norm(e1))
    e2 = cross(ray, e1)
    hidden, drones = 0, poses.shape[0]
    for i in range(drones + 1 if scene.tree.part.shape[0] > 0 else drones):  # the drones, then all that does not move
        if i < drones and (
            i == own or _passes(eye, ray, away, vector(poses[i], STATE.p_WB), RIM_WIDE * hulls[i] + ball)
        ):
            continue
        for point in range(POINTS):
            a, b = ball / away * COSINES[point], ball / away * SINES[point]
            to = axpy(axpy(ray, a, e1), b, e2)
            to = scaled(to, 1.0 / norm(to))
            if (
                _drone_hides(eye, to, away, i, m, poses[i], hulls[i])
                if i < drones
                else cast_parts(scene, eye, to, away) < away
            ):
                hidden |= 1 << point
    return hidden


@inlined
def _write_outline(hidden: int, row: NDArray) -> None:
    """Write the accuracy with which the visible points of a ball's edge determine it."""
    row[VIEW.share], row[VIEW.centre], row[VIEW.radius] = 1.0, 1.0, 1.0
    if hidden == 0:
        return
    around = POINTS - 1  # a detector leaves out the points beside those that are hidden
    hidden |= hidden << 1 | hidden >> 1 | hidden << around | hidden >> around
    n, x, y, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(POINTS):
        if not hidden >> k & 1:
            a, b = COSINES[k], SINES[k]
            n, x, y, xx, xy, yy = n + 1.0, x + a, y + b, xx + a * a, xy + a * b, yy + b * b
    centre, radius = spread(n, x, y, xx, xy, yy)
    row[VIEW.share] = n / POINTS
    row[VIEW.centre], row[VIEW.radius] = centre * math.sqrt(POINTS / 2), radius * math.sqrt(POINTS)


@kernel()
def hats_in_view(
    camera: MountedCamera,
    own: int,
    poses: NDArray,
    hulls: NDArray,
    hat_B: Vector,
    diameter: float,
    balls: NDArray,
    bare: NDArray,
    scene: Scene,
    view: NDArray,
) -> None:
    """Write the hats that a camera has in view.

    Args:
        camera: row of the camera.
        own: index of its drone.
        poses: of N drones at the instant of the picture, (N, STATE.size).
        hulls: radius of each hull [m], (N,).
        hat_B: centre of a hat in the body of its drone [m].
        diameter: of a hat [m].
        balls: centres of balls that only look like hats [m; W], (M, 3).
        bare: whether the hat of each drone is visible at all, (N,).
        scene: obstacles and surfaces.
        view: the result, (N + M, VIEW.size): drones, then balls.
    """
    row = poses[own]
    q_WB, w_B = four(row, STATE.q_WB), vector(row, STATE.w_WB_B)
    eye = add(vector(row, STATE.p_WB), rotate(q_WB, camera.p_BK))
    v_eye = add(vector(row, STATE.v_WB), rotate(q_WB, cross(w_B, camera.p_BK)))
    w_W = rotate(q_WB, w_B)
    drones = poses.shape[0]
    view[:, VIEW.seen] = 0.0
    for m in range(view.shape[0]):
        if m == own or (m < drones and not bare[m]):
            continue
        centre, velocity = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        if m < drones:
            other = four(poses[m], STATE.q_WB)
            centre = add(vector(poses[m], STATE.p_WB), rotate(other, hat_B))
            velocity = vector(poses[m], STATE.v_WB)
        else:
            centre = vector(balls[m - drones], 0)
        to_W = subtract(centre, eye)
        away = norm(to_W)
        to_K = rotate_back(camera.q_BK, rotate_back(q_WB, to_W))
        if away <= diameter:
            continue
        angle = 2.0 * el.asin(0.5 * diameter / away)
        if not _in_picture(camera.lens, to_K, angle):
            continue
        ray = scaled(to_W, 1.0 / away)
        _write_outline(_hidden(eye, ray, away, 0.5 * diameter, own, m, poses, hulls, scene), view[m])
        if view[m, VIEW.share] < SHARE_MIN:
            continue
        across = axpy(subtract(velocity, v_eye), -dot(subtract(velocity, v_eye), ray), ray)
        moves = subtract(scaled(across, 1.0 / away), cross(w_W, ray))
        view[m, VIEW.seen] = 1.0
        for k in range(3):
            view[m, VIEW.direction_K + k] = to_K[k] / away
        view[m, VIEW.range] = away
        view[m, VIEW.angle] = angle
        view[m, VIEW.scale] = _scale(camera.lens, to_K[2] / away)
        view[m, VIEW.rate] = norm(moves)
