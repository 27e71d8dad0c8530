"""Roles of a federation: the names, agent classes, requirements and key rights of their processes.

Launchers, the world and access control use `ROLES`. Rights are the minimum that a role needs. They follow from the
writers and readers declared by the messages of the contract (`zsim.contract.messages.TOPICS`); Zenoh's access control
and the world's replays enforce them.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

from zsim.contract import keys
from zsim.contract.messages import TOPICS
from zsim.errors import ScenarioError
from zsim.scenario.scenario import OnDeath, OnOverdue, OwnAgent, Scenario
from zsim.schema.checker import listed

MAIN = "main"  # second part of the name of an agent that serves the whole run
OPERATOR, RECORDER, WORLD, ROUTER, DRIVER = "operator", "recorder", "world", "router", "driver"
PILOT = "reference"  # role of the pilots of drones with a reference of their own


class Role(NamedTuple):
    """Properties of the processes of one role."""

    extra: str  # extra of the distribution zsim that its hosts need; empty if none
    on_death: OnDeath  # default action on the death of a process
    # scope of its processes, named ROLE.NAME after each drone or cluster; None for roles without an agent
    about: Literal["drone", "cluster", "run"] | None = None
    agent: str = ""  # `package.module:Class` of the agent, constructed from world/info, scenario and name
    joint: bool = False  # whether one agent may replace several, given all their names
    # default action on a process that is overdue; `drop` if the run does not wait for the role
    on_overdue: OnOverdue = "end"


ROLES = {
    "world": Role("world", "restart"),
    "recorder": Role("record", "restart"),
    "estimator": Role("agents", "restart", "drone", "zsim_agents.estimation.estimator:Estimator", joint=True),
    "controller": Role("agents", "restart", "cluster", "zsim_agents.formation.controller:Controller"),
    "reference": Role("agents", "restart", "drone", "zsim_agents.references.pilot:ReferencePilot"),
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


def agent_roles(scenario: Scenario) -> dict[str, Role]:
    """Return the roles of a scenario's agents: the stock roles and those of users' classes."""
    own = {name: Role("agents", "restart", each.per, each.named) for name, each in scenario.own_agents.items()}
    return AGENTS | own


def things(role: str, scenario: Scenario) -> list[str]:
    about = agent_roles(scenario)[role].about
    if role == PILOT:
        return [*scenario.piloted()]
    return [MAIN] if about == "run" else [entry.name for entry in getattr(scenario, f"{about}s")]


def agent_names(scenario: Scenario) -> list[str]:
    return [f"{role}.{thing}" for role in agent_roles(scenario) for thing in things(role, scenario)]


def expected_processes(scenario: Scenario) -> list[str]:
    """Return the names of the processes required at the start of a run."""
    if scenario.processes.expect is not None:
        return list(scenario.processes.expect)
    cameras = [drone.name for drone in scenario.drones if scenario.gates("camera") and drone.sensors.cameras()]
    programs = [name for name, each in scenario.own_programs.items() if each.joins]
    return [*agent_names(scenario), *(f"camera.{name}" for name in cameras), *programs]


def programs(scenario: Scenario) -> list[str]:
    """Return the names of the users' programs started with a run."""
    expected = expected_processes(scenario)
    return [name for name, each in scenario.own_programs.items() if name in expected or not each.joins]


def on_death(actions: Mapping[str, OnDeath], name: str, role: str | None = None) -> OnDeath:
    """Return the action on the death of a process: the scenario's for its name, that for its role, or the default.

    Args:
        actions: the scenario's actions by process name or role.
        role: role in the process's join; by default the first part of its name.
    """
    role = role or name.partition(".")[0]
    default = ROLES[role].on_death if role in ROLES else "drop"
    return actions.get(name) or actions.get(role) or default


def on_overdue(
    actions: Mapping[str, OnOverdue], name: str, role: str | None = None, gating: Collection[str] = ()
) -> OnOverdue:
    """Return the action on an overdue process; arguments as for `on_death`.

    `gating`: roles, other than those of agents, that the run waits for.
    """
    role = role or name.partition(".")[0]
    default = ROLES[role].on_overdue if role in ROLES and role not in gating else "end"
    return actions.get(name) or actions.get(role) or default


def lets_drop(actions: Mapping[str, str], name: str) -> bool:
    """Return whether a scenario explicitly lets a run continue without a process, whose loss is then no failure."""
    return (actions.get(name) or actions.get(name.partition(".")[0])) == "drop"


def is_needed(name: str) -> bool:
    """Return whether by default a run cannot continue without a process."""
    role = ROLES.get(name.partition(".")[0])
    return role is not None and role.on_overdue == "end"


def check_pace(scenario: Scenario, mode: str) -> None:
    """Raise ScenarioError if a mode other than realtime has external drones, which fly in wall time."""
    external = scenario.external()
    if external and mode != "realtime":
        subject = f"{listed(external)} {'is' if len(external) == 1 else 'are'} external"
        needed = "external drones fly in wall time: run with --realtime, in separate processes"
        raise ScenarioError([f"{scenario.name}: body of {subject}, and the run is in {mode}; {needed}"])


def check_alone(scenario: Scenario) -> None:
    """Raise ScenarioError, with a line per field, for settings that a run in one process does not support."""
    lines = []
    if scenario.gates("camera"):
        lines.append(
            "processes.gating is [camera]; must be left out in one process, which has no cameras: "
            "fly it as processes, or with --set processes.gating=[]"
        )
    if scenario.own_programs:
        lines.append(
            f"programs has {', '.join(scenario.own_programs)}; must be left out in one process, which starts no "
            "programs: fly it as processes, or with --set programs={}"
        )
    if lines:
        raise ScenarioError([f"{scenario.name}: {line}" for line in lines])


def drivers_of(scenario: Scenario) -> list[str]:
    return [f"{DRIVER}.{drone}" for drone in scenario.external()]


def driver_lines(scenario: Scenario, endpoint: str) -> list[str]:
    """Return a line about the drivers to start with a run, in a list that is empty without external drones."""
    drivers, awaited_names = drivers_of(scenario), expected_processes(scenario)
    awaited, others = (listed([d for d in drivers if (d in awaited_names) is expected]) for expected in (True, False))
    waits = [f"the run waits for {awaited}"] if awaited else []
    waits += [f"{others} may join at any time"] if others else []
    return [f"external drones: {', and '.join(waits)}; start drivers with --connect {endpoint}"] if drivers else []


# Rights


class Rights(NamedTuple):
    """Key expressions that a process may use, without the federation's prefix."""

    reads: tuple[str, ...] = ()  # subscriptions
    writes: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()  # gets; a get on a control key is a request
    answers: tuple[str, ...] = ()  # answers to gets
    tokens: tuple[str, ...] = ()  # liveliness tokens to declare
    watches: tuple[str, ...] = ()  # liveliness tokens to watch


EVERYTHING = ("**", keys.BATCH, keys.GATE, keys.gate("*"))  # wildcards do not match chunks that begin with @
ALL_RIGHTS = Rights(*[EVERYTHING] * len(Rights._fields))
LAST_VALUES = tuple(key for key, topic in TOPICS.items() if topic.last)
_READER = Rights(reads=("**", keys.BATCH), asks=LAST_VALUES, watches=(keys.token("*"),))


def rights_for(process: str, scenario: Scenario) -> Rights:
    """Return the rights of a process by its name, role.thing; the names of world and recorder are their roles alone.

    A camera or detector that is not named after a drone serves all drones with cameras. A user's process named after a
    drone has the rights of its estimator, one named after a cluster those of its controller, which it may replace. Any
    other process may take part and read the keys that are open to all.
    """
    role, _, thing = process.partition(".")
    if process == WORLD:
        return ALL_RIGHTS
    services = Rights(
        asks=(keys.replay(process),),
        answers=(keys.process(process, "outputs"),),
        tokens=(keys.token(process), keys.session_token(process, "*")),
    )
    own = combined([_granted("each", process=[process]), services])
    if process == RECORDER:
        return combined([own, _READER])
    if role == OPERATOR:
        requests = Rights(asks=(keys.CONTROL, keys.cluster_control("*"), keys.drone_control("*"), keys.driver("*")))
        return combined([own, _READER, _granted(role, drone=["*"]), requests])
    if role == DRIVER:
        is_external = thing in scenario.external()
        return combined([own, *([_granted(role, drone=[thing]), Rights(answers=(keys.driver(thing),))] * is_external)])
    if role in ("camera", "detector"):
        sees = (keys.truth("*"),) if role == "camera" else ()
        return combined([own, Rights(reads=sees, asks=sees), _granted(role, drone=watched_drones(thing, scenario))])
    if role in scenario.own_agents:
        return combined([own, _granted_own(scenario.own_agents[role], thing, scenario)])
    if role == PILOT:
        is_piloted = thing in scenario.piloted()
        answers = Rights(reads=(keys.gate(thing),), answers=(keys.drone_control(thing),))
        return combined([own, *[_granted(PILOT, drone=[thing]), answers] * is_piloted])
    about = AGENTS[role].about if role in AGENTS else None
    granted = [own]
    if about != "cluster" and thing in [drone.name for drone in scenario.drones]:
        sensed = [keys.gate(thing)]
        if scenario.estimation.use_sightings is True:  # it reads all sensors of its cluster's drones
            mates = next((cluster.drones for cluster in scenario.clusters if thing in cluster.drones), [thing])
            sensed.append(keys.GATE)
            for mate in mates:
                sensed += [keys.sensors(mate), keys.gate(mate), keys.detections(mate)]
        granted += [_granted("estimator", drone=[thing], estimates=[process]), Rights(reads=tuple(sensed))]
    if about != "drone" and thing in [cluster.name for cluster in scenario.clusters]:
        cluster = scenario.cluster(thing)
        sensed = tuple(keys.sensor(drone, name) for drone in cluster.drones for name in cluster.law_sensors or ())
        granted.append(_granted("controller", drone=cluster.drones, cluster=[thing]))
        granted.append(Rights(reads=sensed))
        granted.append(Rights(answers=(keys.cluster_control(thing),)))
    return combined(granted)


def _granted_own(agent: OwnAgent, thing: str, scenario: Scenario) -> Rights:
    """Return the rights of a user's agent: to read what agents read, to command its drones, to publish its messages."""
    drones = [drone.name for drone in scenario.drones]
    drones_by_scope = {"drone": [thing], "run": drones}
    own = drones_by_scope.get(agent.per) or scenario.cluster(thing).drones
    reads = [keys.GATE, keys.gate("*"), keys.sensors("*"), keys.estimate("*"), keys.detections("*")]
    reads += [keys.cluster_state("*"), keys.reference("*"), *(each.key for each in scenario.own_messages())]
    writes = [keys.command(drone, "*") for drone in own]
    writes += [each.key.replace("*", thing) for each in agent.declared or ()]
    return combined([_granted("each"), Rights(reads=tuple(reads), writes=tuple(writes), asks=tuple(reads))])


def _granted(role: str, **names: Sequence[str]) -> Rights:
    """Return the rights that the contract's messages give a role on the keys of some drones, clusters or processes.

    `names` lists them by kind of key: `drone`, `cluster`, `process`, and `estimates` for the process itself.
    """
    reads, writes, asks, answers = [], [], [], []
    for key, topic in TOPICS.items():
        if role not in (*topic.readers, *topic.writers):
            continue
        kind = key.partition("/*")[0].rpartition("/")[2]
        expressions = [key.replace("*", name, 1) for name in names.get(kind, ())] if "*" in key else [key]
        reads += expressions if role in topic.readers else []
        writes += expressions if role in topic.writers else []
        if topic.last == "writer" and role in topic.writers:
            answers += expressions
        elif topic.last:
            asks += expressions
    return Rights(tuple(reads), tuple(writes), tuple(asks), tuple(answers))


def watched_drones(thing: str, scenario: Scenario) -> list[str]:
    names = [drone.name for drone in scenario.drones]
    return [thing] if thing in names else [drone.name for drone in scenario.drones if drone.sensors.cameras()]


def combined(rights: Iterable[Rights]) -> Rights:
    """Return the union of several rights, as needed by a router that forwards for all of them."""
    columns = zip(Rights(), *rights, strict=True)
    return Rights(*(tuple(dict.fromkeys(key for keys_ in column for key in keys_)) for column in columns))


def permits(expressions: Iterable[str], key: str) -> bool:
    return any(keys.matches(expression, key) for expression in expressions)
