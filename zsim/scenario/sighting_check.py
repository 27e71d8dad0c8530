"""What cannot go together of cameras, sightings, hats, and estimators that use them. Pure, as `consistency`."""

import math
from collections.abc import Iterator
from typing import Any

from msgspec import UNSET

from zsim.schema.checker import Fault, show
from zsim.sensors.camera_model import folds, lens_of

LEAST_K1 = -4 / 27  # over the squared tangent of half the diagonal: where r + k1 r^3 turns back
SIGHTED_MAX = 12  # drones of a cluster: each of its estimators has the states of all; the cost grows by the square


def sighting_faults(scenario: Any, drones: list[tuple[int, Any]], clusters: list[tuple[int, Any]]) -> Iterator[Fault]:
    """Yield these faults of a scenario, or of the sound parts of one."""
    for index, drone in drones:
        if drone.sensors is not None:
            yield from ((f"drones[{index}].sensors.{path}", text) for path, text in _camera_faults(drone.sensors))
    hats = scenario.environment and scenario.environment.hats
    known = [drone.name for _, drone in drones]
    for place, name in enumerate(hats.covered or () if hats else ()):
        if name not in known:
            yield f"environment.hats.covered[{place}]", f"is {show(name)}; must be one of {', '.join(map(str, known))}"
    if scenario.estimation is not None and scenario.estimation.use_sightings is True:
        yield from _estimation_faults(scenario.estimation, drones, clusters)


def _camera_faults(sensors: Any) -> Iterator[Fault]:
    cameras = {"front": sensors.front_camera, "bottom": sensors.bottom_camera}
    for name, camera in cameras.items():
        if camera:
            yield from ((f"{name}_camera.{path}", text) for path, text in _lens_faults(camera))
    looks_at = (sensors.sightings and sensors.sightings.cameras) or ()
    for place, name in enumerate(looks_at):
        path = f"sightings.cameras[{place}]"
        if name in looks_at[:place]:
            yield path, f"is {name!r}, as cameras[{looks_at.index(name)}]; must be unique"
        elif name in cameras and not cameras[name]:
            yield path, f"is {name!r}, which the drone does not have; give it {name}_camera: {{}}"


def _lens_faults(camera: Any) -> Iterator[Fault]:
    of_lens = camera.width_px, camera.height_px, camera.diagonal_deg, camera.distortion
    if None not in of_lens and None not in camera.distortion and folds(lens_of(camera)):
        least = LEAST_K1 / math.tan(math.radians(camera.diagonal_deg) / 2) ** 2
        given = f"is {list(camera.distortion)}, which folds a picture of {camera.diagonal_deg:g} deg"
        yield "distortion", f"{given}; must give every pixel a ray of its own, k1 alone more than {least:.3f}"
    if None not in (camera.exposure_ms, camera.rate_hz) and camera.exposure_ms * camera.rate_hz > 1e3:
        most = f"{1e3 / camera.rate_hz:.4g} ms at rate_hz {camera.rate_hz:g}"
        yield "exposure_ms", f"is {camera.exposure_ms:g}; must be <= {most}, the time from one picture to the next"


def _estimation_faults(
    estimation: Any, drones: list[tuple[int, Any]], clusters: list[tuple[int, Any]]
) -> Iterator[Fault]:
    path = "estimation.use_sightings"
    if estimation.algorithm not in (UNSET, None, "ekf"):
        yield path, f"is true; must be false with algorithm {show(estimation.algorithm)}: only ekf uses them"
    sensors = [drone.sensors for _, drone in drones if drone.sensors is not None]
    if sensors and not any(each.front_camera or each.bottom_camera for each in sensors):
        yield path, "is true and no drone has a camera; give one sensors.front_camera, and sightings or a detector"
    for index, cluster in clusters:
        count = len(cluster.drones or ())
        if count > SIGHTED_MAX:
            where = f"clusters[{index}].drones"
            yield where, f"has {count}; must have at most {SIGHTED_MAX} where estimation.use_sightings is true"
