"""The cameras of a run: which drones have any, and which cameras and detectors are started, each of which drones."""

from typing import NamedTuple

from msgspec.structs import replace

from zsim.scenario.roles import watched_drones
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import BottomCamera, FrontCamera


class CameraChild(NamedTuple):
    """A camera or detector that is started with a run.

    Attributes:
        role: `camera` or `detector`.
        name: of the process.
        drones: whose cameras it is for; empty for all that have cameras.
    """

    role: str
    name: str
    drones: tuple[str, ...] = ()


def with_cameras(scenario: Scenario) -> Scenario:
    """Return a scenario in which some drone has a camera: where none has, all get the AR.Drone's two."""
    if any(drone.sensors.cameras() for drone in scenario.drones):
        return scenario
    two = {"front_camera": FrontCamera(), "bottom_camera": BottomCamera()}
    drones = [replace(drone, sensors=replace(drone.sensors, **two)) for drone in scenario.drones]
    return replace(scenario, drones=drones)


def camera_children(scenario: Scenario, cameras: bool, detect: bool) -> list[CameraChild]:
    """Return the cameras and detectors that a scenario expects, as far as they are known by name, or that a user wants.

    Args:
        cameras: whether all that have cameras are to have their pictures drawn.
        detect: whether hats are to be found in the pictures of all.
    """
    having = watched_drones("", scenario)
    everybody = [drone.name for drone in scenario.drones]  # a detector's cameras need not be zsim's
    return [
        *_of_role("camera", having, having, scenario, cameras),
        *_of_role("detector", everybody, having or everybody, scenario, detect),
    ]


def _of_role(role: str, known: list[str], all_: list[str], scenario: Scenario, wanted: bool) -> list[CameraChild]:
    """Return one for each drone that a name in `expect` is about, and ROLE.main for the others."""
    expected = scenario.processes.expect or ()
    made = [CameraChild(role, f"{role}.{drone}", (drone,)) for drone in known if f"{role}.{drone}" in expected]
    main = f"{role}.main"
    others = tuple(drone for drone in all_ if f"{role}.{drone}" not in expected)
    if all_ and main not in {child.name for child in made} and (main in expected or (wanted and others)):
        made.append(CameraChild(role, main, others if made else ()))
    return made
