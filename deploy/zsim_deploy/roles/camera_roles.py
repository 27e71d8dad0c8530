"""Cameras and detectors as processes of a run: of which drones they are, once the run is known."""

from collections.abc import Callable, Sequence

from msgspec import UNSET

from zsim.contract.messages import Info
from zsim.scenario import scenario_file
from zsim.scenario.roles import watched_drones
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import Hats
from zsim.transport.session import Session
from zsim_agents.cameras import camera_process, detector_process
from zsim_agents.hosting import chosen
from zsim_bridges.observer_process import ObserverProcess

SLACK_GATES = 3  # a picture between two gates needs the second; one more, and the world and the cameras work at once
Stopped = Callable[[], bool]
Say = Callable[[str], None]
Drones = Callable[[Info, Sequence[str]], list[str]]


def camera(
    link: Session, info: Info, presence: ObserverProcess, stopped: Stopped, say: Say, names: Sequence[str]
) -> None:
    """Serve a run with pictures of the cameras of some drones, named or by patterns.

    Raises:
        RunError: no drone with a camera has such a name.
    """
    drones = of_camera(info, names)
    say(f"{presence.name}: draws for {', '.join(drones)}")
    camera_process.serve(link, info, presence, stopped, scenario_file.from_text(info.scenario), drones)


def detector(
    link: Session,
    info: Info,
    presence: ObserverProcess,
    stopped: Stopped,
    say: Say,
    names: Sequence[str],
    diameter_m: float | None,
) -> None:
    """Serve a run with what is seen in the pictures of some drones; their cameras need not be zsim's.

    Args:
        diameter_m: of a hat; None for the scenario's.

    Raises:
        RunError: no drone has such a name.
    """
    drones = of_detector(info, names)
    say(f"{presence.name}: looks at the pictures of {', '.join(drones)}")
    diameter_m = diameter_m or hat_diameter_m(scenario_file.from_text(info.scenario))
    detector_process.serve(link, presence, stopped, say, drones, diameter_m)


def of_camera(info: Info, names: Sequence[str]) -> list[str]:
    """Return the drones of a camera process.

    Raises:
        RunError: no drone with a camera has such a name.
    """
    scenario = scenario_file.from_text(info.scenario)
    with_cameras = [drone.name for drone in scenario.drones if drone.sensors.cameras()]
    return chosen("camera: drone with a camera", names or ["*"], with_cameras)


def of_detector(info: Info, names: Sequence[str]) -> list[str]:
    """Return the drones of a detector process; their cameras need not be zsim's.

    Raises:
        RunError: no drone has such a name.
    """
    scenario = scenario_file.from_text(info.scenario)
    everybody = [drone.name for drone in scenario.drones]
    return chosen("detect: drone", names, everybody) if names else watched_drones("", scenario) or everybody


def stands_for(role: str, drones: Drones, names: Sequence[str], info: Info) -> tuple[str, ...]:
    """Return the names of the processes, one for each drone, whose work a process for several does."""
    return tuple(f"{role}.{drone}" for drone in drones(info, names))


def slack_ns(role: str, info: Info) -> int:
    """Return by how much the world may be ahead of a role; 0 for any, where nothing waits for it, as in a replay."""
    gates = not info.replay_of and scenario_file.from_text(info.scenario).gates(role)
    return SLACK_GATES * info.gate_ns if gates else 0


def hat_diameter_m(scenario: Scenario) -> float:
    """Return the diameter of the hats of a scenario."""
    hats = scenario.environment.hats
    return (Hats() if hats is UNSET else hats).diameter_m
