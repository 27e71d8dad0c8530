"""The roles of a federation, in one table: what a process of each is named after, made of, and needs.

Launchers, the world and access control read it; what a role may do on the keys is in `rights`.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import Literal, NamedTuple

from zsim.contract import keys
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


TOLD_TO_ALL = (keys.INFO, keys.CLOCK, keys.EVENT, keys.FAULTS)
EVERYTHING = ("**", keys.BATCH, keys.GATE, keys.gate("*"))  # no wildcard takes a key that begins with @
LAST_VALUES = (
    keys.INFO,
    keys.CLOCK,
    keys.FAULTS,
    "drone/*/sensor/status",
    "drone/*/truth",
    "drone/*/estimate",
    keys.link("*"),
    keys.camera_info("*", "*"),
    "cluster/*/state",
    "process/*/snapshot",
)
OPERATOR, RECORDER, WORLD, ROUTER, DRIVER = "operator", "recorder", "world", "router", "driver"


class Rights(NamedTuple):
    """Key expressions, without the federation.

    Attributes:
        reads: what it may subscribe to.
        writes: what it may publish.
        asks: what it may get; a get on a control key is a request.
        answers: what it may answer gets on.
        tokens: liveliness tokens that it may declare.
        watches: liveliness tokens that it may see.
    """

    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    tokens: tuple[str, ...] = ()
    watches: tuple[str, ...] = ()


ALL_RIGHTS = Rights(*[EVERYTHING] * len(Rights._fields))


def rights_for(process: str, scenario: Scenario) -> Rights:
    """Return the rights of a process by its name, role.thing; there is one world and one recorder, without a thing.

    A camera, or a detector, that is not named after a drone is for all that have cameras.
    A role that is not zsim's and is about a drone may do what the estimator of that drone may, one that is about a
    cluster what its controller may: it takes their place. One about neither takes part, and reads what all read.
    """
    role, _, thing = process.partition(".")
    if process == WORLD:
        return ALL_RIGHTS
    if process == RECORDER:
        return combined([_own(process), _READER])
    if role == OPERATOR:
        return combined([_own(process), _READER, _OPERATOR])
    if role == DRIVER:
        return combined([_own(process), _driver_rights(thing, scenario)])
    if role in _OF_CAMERAS:
        return combined([_own(process), *(_OF_CAMERAS[role](drone) for drone in watched_drones(thing, scenario))])
    about = AGENTS[role].about if role in AGENTS else None
    granted = [rights(thing, scenario, role) for kind, rights in _ABOUT.items() if about in (None, kind)]
    return combined([_own(process), *granted])


def watched_drones(thing: str, scenario: Scenario) -> list[str]:
    """Return the drones of a camera or detector: the one it is named after, or all that have cameras."""
    names = [drone.name for drone in scenario.drones]
    return [thing] if thing in names else [drone.name for drone in scenario.drones if drone.sensors.cameras()]


def combined(many: Iterable[Rights]) -> Rights:
    """Return what any of several may do, as a router needs that carries them."""
    columns = zip(Rights(), *many, strict=True)
    return Rights(*(tuple(dict.fromkeys(key for keys_ in column for key in keys_)) for column in columns))


def permits(expressions: Iterable[str], key: str) -> bool:
    """Tell whether a key is among some expressions."""
    return any(keys.matches(expression, key) for expression in expressions)


def _own(process: str) -> Rights:
    """Return what every process may do in its own name."""
    return Rights(
        reads=TOLD_TO_ALL,
        writes=tuple(keys.process(process, what) for what in ("join", "done", "snapshot", "bye", "health")),
        asks=(keys.INFO, keys.CLOCK, keys.FAULTS, keys.process(process, "snapshot"), keys.replay(process)),
        answers=(keys.process(process, "outputs"),),
        tokens=(keys.token(process), keys.session_token(process, "*")),
    )


_READER = Rights(reads=("**", keys.BATCH), asks=LAST_VALUES, watches=(keys.token("*"),))
_OPERATOR = Rights(writes=(keys.command("*", "*"),), asks=(keys.CONTROL, keys.cluster_control("*"), keys.driver("*")))


def _about_drone(thing: str, scenario: Scenario, role: str) -> Rights:
    """Return what an estimator of a drone may do."""
    if thing not in {drone.name for drone in scenario.drones}:
        return Rights()
    estimate = (keys.estimate(thing),)
    return Rights(
        reads=(keys.sensors(thing), keys.gate(thing), *estimate, *_of_mates(thing, scenario)),
        writes=(*estimate, keys.estimates_view(f"{role}.{thing}")),
        asks=(keys.status(thing), *estimate),
    )


def _driver_rights(thing: str, scenario: Scenario) -> Rights:
    """Return what the driver of an external drone may do: what the world does for a simulated one, for it alone."""
    if thing not in scenario.external():
        return Rights()
    last = (keys.status(thing), keys.truth(thing), keys.estimate(thing), keys.link(thing))
    return Rights(
        reads=(keys.accepted(thing, "*"),),
        writes=(keys.sensors(thing), keys.truth(thing), keys.estimate(thing), keys.link(thing)),
        asks=last,
        answers=(keys.driver(thing),),
    )


def _of_mates(thing: str, scenario: Scenario) -> tuple[str, ...]:
    """Return what an estimator reads that uses sightings: all that the drones of its cluster sense."""
    if scenario.estimation.use_sightings is not True:
        return ()
    mates = next((cluster.drones for cluster in scenario.clusters if thing in cluster.drones), [thing])
    expressions = (keys.sensors, keys.gate, keys.detections)
    return (keys.GATE, *(expression(mate) for mate in mates for expression in expressions))


def _about_cluster(thing: str, scenario: Scenario, role: str) -> Rights:
    """Return what a controller of a cluster may do."""
    if thing not in {cluster.name for cluster in scenario.clusters}:
        return Rights()
    drones = scenario.cluster(thing).drones
    estimates_and_states = [key for drone in drones for key in (keys.estimate(drone), keys.status(drone))]
    state = keys.cluster_state(thing)
    return Rights(
        reads=(*estimates_and_states, state),
        writes=(
            *(keys.command(drone, "*") for drone in drones),
            state,
            keys.cluster_request(thing),
            keys.cluster_view(thing),
        ),
        asks=(*estimates_and_states, state),
        answers=(keys.cluster_control(thing),),
    )


def _camera(drone: str) -> Rights:
    """Return what a camera of a drone may do: it sees all drones."""
    info = (keys.camera_info(drone, "*"),)
    truth = (keys.truth("*"),)
    return Rights(reads=truth, writes=(keys.camera(drone, "*"), *info), answers=info, asks=truth)


def _detector(drone: str) -> Rights:
    """Return what a detector for a drone's cameras may do."""
    info = keys.camera_info(drone, "*")
    return Rights(reads=(keys.camera(drone, "*"), info), writes=(keys.detections(drone),), asks=(info,))


_OF_CAMERAS = {"camera": _camera, "detector": _detector}
_ABOUT = {"drone": _about_drone, "cluster": _about_cluster}
