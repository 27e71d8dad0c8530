"""Camera pictures of two drones for tests: one drone looks at the other's hat."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math.frames import quaternion_from_rpy, rotation_matrix
from zsim.sensors.camera import BottomCamera, Camera, FrontCamera, Hats
from zsim.sensors.camera_model import camera_pose, lens_of, pixel
from zsim_agents.cameras.renderer import Renderer
from zsim_agents.cameras.scene import DroneStates, Scene, default_look

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
HATS = Hats()
CLEAN: dict[str, Any] = {"noise": 0.0, "blur_px": 0.0}
FRONT, BOTTOM = FrontCamera(), BottomCamera()
ROTOR_RAD_S = 400.0


def bodies(p_W: Any, rpy_rad: Any = None, v_W: Any = None, w_B: Any = None) -> DroneStates:
    """Return the states of drones at positions (N, 3); by default level, at rest and facing east."""
    p = np.array(p_W, float)
    rpy, v, w = (np.zeros_like(p) if each is None else np.array(each, float) for each in (rpy_rad, v_W, w_B))
    return DroneStates(p, v, quaternion_from_rpy(rpy), w, [[ROTOR_RAD_S] * 4] * len(p))


def scene(drones: int = 2, **fields: Any) -> Scene:
    """Return a scene with a number of AR.Drones."""
    return Scene(tuple(default_look() for _ in range(drones)), **fields)


def renderer(camera: Camera = FRONT, of: Scene | None = None, seed: int = 1, **fields: Any) -> Renderer:
    """Return the renderer of a camera of the first drone."""
    return Renderer(camera, of or scene(), 0, seed, "drone1/front", **fields)


def hat_K(camera: Camera, where: DroneStates, drone: int = 1) -> Array:
    """Return the position of a drone's hat relative to the first drone's camera [m; K]."""
    R_WB, R_WD = rotation_matrix(where.q_WB[0]), rotation_matrix(where.q_WB[drone])
    pose = camera_pose(camera)
    hat_B = R_WB.T @ (where.p_WB[drone] + R_WD @ np.array(HATS.position_m) - where.p_WB[0])
    return pose.R_BK.T @ (hat_B - pose.p_BK)


def hat_pixel(camera: Camera, where: DroneStates, drone: int = 1) -> tuple[float, float]:
    """Return the pixel of the centre of a drone's hat in the first drone's camera."""
    x, y, z = hat_K(camera, where, drone).tolist()
    return pixel(lens_of(camera), x, y, z)


def magenta_centre(picture: Picture) -> Array:
    """Return the centroid of the magenta in a picture [px], computed independently of the detector."""
    b, g, r = (picture[..., k].astype(float) for k in range(3))
    level = np.minimum(b, r) - g
    # The weight rises from a quarter to three quarters of the greatest level, which excludes shade.
    weight = np.clip(level / max(level.max(), 1.0) * 2 - 0.5, 0, 1)
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def has_magenta(picture: Picture) -> bool:
    """Return whether anything in a picture is magenta."""
    b, g, r = (picture[..., k].astype(int) for k in range(3))
    return bool((np.minimum(b, r) - g > 60).any())


class Look(NamedTuple):
    """A situation in which one drone sees another's hat: the drones, and the hat's direction (in B) and distance."""

    where: DroneStates
    direction_B: Array
    range_m: float


def looks(count: int, seed: int, ranges_m: Sequence[float] = (1.5, 9.0), rate_rad_s: float = 0.0) -> Iterator[Look]:
    """Yield random situations: both drones tilted by a few degrees, the other one anywhere in the front picture and
    below the camera, so that no hull hides its hat."""
    rng = np.random.default_rng(seed)
    pose = camera_pose(FRONT)
    for _ in range(count):
        p = np.array([*rng.uniform(-20, 20, 2), rng.uniform(6, 9)])
        rpy, other = ([*rng.normal(0, 0.06, 2), rng.uniform(-3.1, 3.1)] for _ in range(2))
        R_WB, R_WD = (rotation_matrix(quaternion_from_rpy(each)) for each in (rpy, other))
        distance = math.exp(rng.uniform(*np.log(ranges_m)))
        azimuth, down = rng.uniform(-0.6, 0.6), rng.uniform(0.05, 0.3)
        d = np.array([math.cos(down) * math.cos(azimuth), math.cos(down) * math.sin(azimuth), -math.sin(down)])
        hat_W = p + R_WB @ (pose.p_BK + distance * d)
        w = [rng.normal(0, rate_rad_s, 3), np.zeros(3)]
        yield Look(bodies([p, hat_W - R_WD @ np.array(HATS.position_m)], [rpy, other], w_B=w), d, distance)
