"""The roles of a federation, in one table: what a process of each is named after, made of, and needs.

Launchers, the world and access control read it; what a role may do on the keys is in `rights`.
"""

from collections.abc import Collection, Mapping
from typing import Literal, NamedTuple

from zsim.errors import ScenarioError
from zsim.scenario.scenario import OnDeath, OnOverdue, Scenario
from zsim.schema.checker import listed


class Role(NamedTuple):
    """What is to be known of a role.

    Attributes:
        extra: of the distribution, that a host of it needs; empty for none.
        on_death: what the death of a process means for a run where the scenario does not say.
        about: what its processes are named after, ROLE.NAME of each drone or cluster; None for roles without an agent.
        agent: `package.module:Class` of the agent, made of world/info, scenario and name.
        joint: one agent may do the work of many, made of all their names.
        on_overdue: what follows where it does not come back and the scenario does not say; `drop` where nothing waits
    """

    extra: str
    on_death: OnDeath
    about: Literal["drone", "cluster"] | None = None
    agent: str = ""
    joint: bool = False
    on_overdue: OnOverdue = "end"


ROLES = {
    "world": Role("world", "restart"),
    "recorder": Role("record", "restart"),
    "estimator": Role("agents", "restart", "drone", "zsim_agents.estimation.estimator:Estimator", joint=True),
    "controller": Role("agents", "restart", "cluster", "zsim_agents.formation.controller:Controller"),
    "camera": Role("cameras", "restart", on_overdue="drop"),
    "detector": Role("cameras", "restart", on_overdue="drop"),
    "console": Role("console", "drop", on_overdue="drop"),
    "gateway": Role("gateway", "drop", on_overdue="drop"),
    "ros1": Role("ros1", "drop", on_overdue="drop"),
    "ros2": Role("ros2", "drop", on_overdue="drop"),
    "mavlink": Role("", "drop", on_overdue="drop"),
    "ardrone": Role("", "drop", on_overdue="drop"),
    "driver": Role("", "restart", on_overdue="drop"),
    "router": Role("", "restart"),
}
AGENTS = {name: role for name, role in ROLES.items() if role.about}


def things(role: str, scenario: Scenario) -> list[str]:
    """Return the names of the drones or clusters that a role with agents is about."""
    return [entry.name for entry in getattr(scenario, f"{AGENTS[role].about}s")]


def agent_names(scenario: Scenario) -> list[str]:
    """Return the names of all processes with agents that a scenario has, role by role."""
    return [f"{role}.{thing}" for role in AGENTS for thing in things(role, scenario)]


def expected_processes(scenario: Scenario) -> list[str]:
    """Return the names of the processes without which a run does not start."""
    if scenario.processes.expect is not None:
        return list(scenario.processes.expect)
    cameras = [drone.name for drone in scenario.drones if scenario.gates("camera") and drone.sensors.cameras()]
    return [*agent_names(scenario), *(f"camera.{name}" for name in cameras)]


def on_death(actions: Mapping[str, OnDeath], name: str, role: str | None = None) -> OnDeath:
    """Return what is to be done when a process dies: what the scenario has for it, else for its role, else the default.

    Args:
        actions: of the scenario, by process name or role.
        name: of the process.
        role: that it says it has; else what its name begins with.
    """
    role = role or name.partition(".")[0]
    default = ROLES[role].on_death if role in ROLES else "drop"
    return actions.get(name) or actions.get(role) or default


def on_overdue(
    actions: Mapping[str, OnOverdue], name: str, role: str | None = None, gating: Collection[str] = ()
) -> OnOverdue:
    """Return what is to be done when a process has not come back in its time.

    Args:
        actions, name, role: as of `on_death`.
        gating: roles for which the run waits beside the agents.
    """
    role = role or name.partition(".")[0]
    default = ROLES[role].on_overdue if role in ROLES and role not in gating else "end"
    return actions.get(name) or actions.get(role) or default


def lets_drop(actions: Mapping[str, str], name: str) -> bool:
    """Tell whether a scenario says itself that a run goes on without a process: that is no failure then.

    Args:
        actions: `on_death` or `on_overdue` of the scenario, by process name or role.
        name: of the process.
    """
    return (actions.get(name) or actions.get(name.partition(".")[0])) == "drop"


def is_needed(name: str) -> bool:
    """Tell whether a run cannot go on without a process, by its role, unless the scenario says so."""
    role = ROLES.get(name.partition(".")[0])
    return role is not None and role.on_overdue == "end"


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
    return [f"driver.{drone}" for drone in scenario.external()]


def driver_lines(scenario: Scenario, endpoint: str) -> list[str]:
    """Return what to tell whoever starts a run of the drivers that are to be started beside it; a line, or none."""
    drivers, awaited_names = drivers_of(scenario), expected_processes(scenario)
    awaited, others = (listed([d for d in drivers if (d in awaited_names) is wanted]) for wanted in (True, False))
    waits = [f"the run waits for {awaited}"] if awaited else []
    waits += [f"{others} may come at any time"] if others else []
    return [f"external drones: {', and '.join(waits)}; start drivers with --connect {endpoint}"] if drivers else []
