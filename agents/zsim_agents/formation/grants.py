"""The inputs that the scenario grants to a cluster's law beside the estimates: sensor samples and the map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

from msgspec import UNSET, convert

from zsim.contract import keys
from zsim.contract.messages import decode, encode, type_of
from zsim.contract.snapshot import State
from zsim.errors import UserCodeError
from zsim.scenario.scenario import Cluster, Environment, Obstacle, Surface
from zsim.schema import plugin
from zsim.sensors.sensor import Sample

Kind = TypeVar("Kind", bound=Sample)


class Map(NamedTuple):
    """Obstacles and surfaces of the scenario in W, including those of its forest, corridor and cloud."""

    obstacles: Sequence[Obstacle]
    surfaces: Sequence[Surface]


class Grants:
    """The inputs of one law: the newest sample of each granted sensor of each drone, and the map if granted.

    Attributes:
        t_ns: the present gate [ns].
        keys: keys of the granted sensors, which the law's process must read.
    """

    def __init__(
        self, cluster: str = "NAME", drones: Sequence[str] = (), sensors: Sequence[str] = (), its_map: Map | None = None
    ) -> None:
        self.t_ns = 0
        self._cluster, self._map = cluster, its_map
        self._newest: dict[str, list[Sample | None]] = {name: [None] * len(drones) for name in sensors}
        self._received: dict[str, Any] = {name: type_of(keys.sensor(drones[0], name)) for name in sensors}
        self._drones: Sequence[str] = drones
        self._places = self._numbered()
        self.keys = tuple(self._places)

    def _numbered(self) -> dict[str, tuple[str, int]]:
        return {keys.sensor(drone, name): (name, i) for name in self._newest for i, drone in enumerate(self._drones)}

    def seat(self, drones: Sequence[str]) -> None:
        """Set the order of the drones to that of the robots."""
        if not self.keys:
            return
        order = [self._drones.index(drone) for drone in drones]
        self._newest = {name: [newest[k] for k in order] for name, newest in self._newest.items()}
        self._drones = drones
        self._places = self._numbered()

    def put(self, key: str, sample: Sample) -> None:
        name, place = self._places[key]
        former = self._newest[name][place]
        if former is None or sample.t_ns >= former.t_ns:  # in realtime an older one may come later
            self._newest[name][place] = sample

    def samples(self, law: type, sensor: str, kind: type[Kind]) -> tuple[Kind | None, ...]:
        """Implement `ControlLaw.samples`; a UserCodeError names the law's class."""
        if sensor not in self._newest:
            listed = ", ".join([*self._newest, sensor])
            raise self._not_granted(law, f"sensor {sensor!r:.40}", "law_sensors", f"law_sensors: [{listed}]")
        received = self._received[sensor]
        if received not in (None, kind) and not _is_declared_as(received, kind):
            what = f"{plugin.full_name(law)} reads {sensor!r} as {getattr(kind, '__name__', kind)!s:.40}"
            raise UserCodeError(f"{what}; must be {received.__name__}, the class of its messages")
        newest = self._newest[sensor]
        for place, sample in enumerate(newest):
            if sample is not None and type(sample) is not kind:  # made of what `world/info` says of a user's sensor
                newest[place] = convert(sample, kind, from_attributes=True)
        return tuple(newest)  # type: ignore[return-value] - converted above

    def map_for(self, law: type) -> Map:
        if self._map is None:
            raise self._not_granted(law, "the map", "law_map", "law_map: true")
        return self._map

    def _not_granted(self, law: type, what: str, field: str, line: str) -> UserCodeError:
        where = f"{plugin.full_name(law)} reads {what}, which clusters.{self._cluster}.{field} does not grant"
        return UserCodeError(f"{where}; write `{line}` there, or leave it out of the class")

    def snapshot(self) -> State:
        newest = ((key, self._newest[name][place]) for key, (name, place) in self._places.items())
        return {key: encode(sample) for key, sample in newest if sample is not None}

    def restore(self, state: State) -> None:
        for key, payload in state.items():
            name, place = self._places[key]
            self._newest[name][place] = decode(key, payload)


def _is_declared_as(received: Any, kind: Any) -> bool:
    """Tell whether a message class made from its declaration corresponds to a user's class."""
    names = [(getattr(each, "__name__", None), getattr(each, "__struct_fields__", None)) for each in (received, kind)]
    return names[0] == names[1]


def grants_of(cluster: Cluster, environment: Environment) -> Grants:
    surfaces = [] if environment.surfaces is UNSET else environment.surfaces
    its_map = Map(environment.obstacles, surfaces) if cluster.law_map is True else None
    return Grants(cluster.name, cluster.drones, cluster.law_sensors or (), its_map)


def granted(law: Any, grants: Grants) -> Any:
    """Return a subclass of a law's class whose instances receive these grants in the constructor of `ControlLaw`."""
    own = {"_granted": grants, "__module__": law.__module__, "__qualname__": law.__qualname__, "__doc__": law.__doc__}
    return type(law.__name__, (law,), own)
