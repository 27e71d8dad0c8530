"""What each process may do on the keys of the contract: the least that its role needs. Pure.

Zenoh's access control is made of it (deploy), and the world answers replays by it.
"""

from collections.abc import Iterable
from typing import NamedTuple

from zsim.contract import keys
from zsim.scenario.roles import AGENTS
from zsim.scenario.scenario import Scenario

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
