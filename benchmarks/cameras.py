"""Measure the CPU time of drawing a picture and of finding hats in it, on one thread.

    python -m benchmarks.cameras [PICTURES]

A front camera of 640 x 360 px sees ten drones, hovering and in motion; drawing is timed for a bottom camera, too. If a
folder PICTURES is given, the pictures of docs/cameras.md are written to it instead.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from zsim.math.frames import quaternion_from_rpy
from zsim.sensors.camera import BottomCamera, Camera, FrontCamera, Hats
from zsim.sensors.camera_model import camera_pose, lens_of
from zsim_agents.cameras.detector import HatDetector, decoded
from zsim_agents.cameras.renderer import Renderer
from zsim_agents.cameras.scene import DroneStates, Scene, default_look

DRONES = 11  # the first looks at the other ten
REPEATS, CALLS = 30, 20  # the minimum of REPEATS means of CALLS calls excludes other load
ROTOR_RAD_S = 400.0  # rad/s; roughly the speed in hover


def situation(moving: bool = False) -> DroneStates:
    """Return the states of a drone and of ten others, 4.2 to 15 m ahead of it."""
    rng = np.random.default_rng(3)
    ahead = np.array([0.0, *(3 + 1.2 * np.arange(1, DRONES))])
    p = np.stack([ahead, rng.uniform(-0.5, 0.5, DRONES) * ahead, 4 + rng.uniform(-0.15, 0.15, DRONES) * ahead], axis=-1)
    rpy = np.column_stack([rng.normal(0, 0.05, (DRONES, 2)), rng.uniform(-3, 3, DRONES)])
    rpy[0] = (0.05, 0.03, 0.0)
    rates = np.full((DRONES, 3), 0.4 if moving else 0.0)
    speeds = rng.normal(0, 0.7, (DRONES, 3)) if moving else np.zeros((DRONES, 3))
    return DroneStates(p, speeds, quaternion_from_rpy(rpy), rates, [[ROTOR_RAD_S] * 4] * DRONES)


def formation() -> DroneStates:
    """Return the states of three drones in a triangle at a height of 4 m, the first facing the others."""
    p = np.array([(0.0, 0.0, 4.0), (3.0, 1.2, 4.0), (4.0, -1.3, 4.0)])
    rpy = np.array([(0.02, 0.03, 0.0), (0.05, 0.0, 2.6), (0.0, 0.04, -2.2)])
    still = np.zeros((3, 3))
    return DroneStates(p, still, quaternion_from_rpy(rpy), still, [[ROTOR_RAD_S] * 4] * 3)


def cpu_ms(call: Callable[[], object]) -> float:
    call()
    means = []
    for _ in range(REPEATS):
        start_s = time.process_time()
        for _ in range(CALLS):
            call()
        means.append((time.process_time() - start_s) / CALLS * 1e3)
    return min(means)


def renderer(camera: Camera, drones: int) -> Renderer:
    scene = Scene(tuple(default_look() for _ in range(drones)))
    return Renderer(camera, scene, 0, 1, "drone1/camera")


def measure() -> None:
    camera = FrontCamera()
    drawn = renderer(camera, DRONES)
    detector = HatDetector(lens_of(camera), camera_pose(camera), Hats().diameter_m)
    for name, where in (("hovering", situation()), ("moving", situation(moving=True))):
        data = drawn.jpeg(0, 1.0, where)
        picture = decoded(data, camera.width_px, camera.height_px)
        seen = len(detector.seen(picture))
        print(
            f"{name}: render and JPEG {cpu_ms(lambda where=where: drawn.jpeg(0, 1.0, where)):.2f} ms, {len(data)} bytes"
        )
        print(f"{name}: decode {cpu_ms(lambda data=data: decoded(data, 640, 360)):.2f} ms")
        print(f"{name}: detect {cpu_ms(lambda picture=picture: detector.seen(picture)):.2f} ms, {seen} hats seen")
    below = renderer(BottomCamera(), DRONES)
    print(f"bottom, 320 x 240: render and JPEG {cpu_ms(lambda: below.jpeg(0, 1.0, situation())):.2f} ms")


def write_pictures(folder: Path) -> None:
    for name, camera in (("front", FrontCamera()), ("bottom", BottomCamera())):
        picture = renderer(camera, 3).picture(0, 1.0, formation())
        cv2.imwrite(str(folder / f"camera_{name}.png"), picture)


if __name__ == "__main__":
    for folder in sys.argv[1:]:
        write_pictures(Path(folder))
    if len(sys.argv) == 1:
        measure()
