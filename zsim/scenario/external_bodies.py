"""Drones whose bodies are external: what a run with them needs."""

from zsim.errors import ScenarioError
from zsim.scenario.fault_check import listed
from zsim.scenario.rights import DRIVER
from zsim.scenario.scenario import Scenario


def check_pace(scenario: Scenario, mode: str) -> None:
    """Refuse to run external drones, whose time is the wall's, otherwise than in realtime.

    Raises:
        ScenarioError: the scenario has some, and the mode is not "realtime".
    """
    external = scenario.external()
    if external and mode != "realtime":
        who = f"{listed(external)} {'is' if len(external) == 1 else 'are'} external"
        needed = "time passes there as on the wall: run it with --realtime, on processes of its own"
        raise ScenarioError([f"{scenario.name}: body of {who}, and the run is in {mode}; {needed}"])


def drivers_of(scenario: Scenario) -> list[str]:
    """Return the names of the processes that publish the external drones."""
    return [f"{DRIVER}.{drone}" for drone in scenario.external()]


def driver_lines(scenario: Scenario, endpoint: str) -> list[str]:
    """Return what to tell whoever starts a run of the drivers that are to be started beside it; a line, or none."""
    drivers, expected = drivers_of(scenario), scenario.expected()
    awaited, others = (listed([d for d in drivers if (d in expected) is wanted]) for wanted in (True, False))
    waits = [f"the run waits for {awaited}"] if awaited else []
    waits += [f"{others} may come at any time"] if others else []
    return [f"external drones: {', and '.join(waits)}; start drivers with --connect {endpoint}"] if drivers else []
