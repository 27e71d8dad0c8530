"""What cannot go together of cameras, sightings, hats, and estimators that use them. Pure, as `consistency`."""

from collections.abc import Iterator
from typing import Any

from msgspec import UNSET

from zsim.schema.checker import Fault, show

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
    model = sensors.sightings
    if not model:
        return
    cameras = {"front": sensors.front_camera, "bottom": sensors.bottom_camera}
    for place, name in enumerate(model.cameras or ()):
        if name in cameras and not cameras[name]:
            yield (
                f"sightings.cameras[{place}]",
                f"is {name!r}, which the drone does not have; give it {name}_camera: {{}}",
            )


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
