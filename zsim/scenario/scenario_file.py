"""Scenario files: read, override, resolve, check, and write out again as the text of `world/info`."""

import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec

from zsim.errors import DocumentError, NotTrustedError, ScenarioError
from zsim.scenario import overrides as override
from zsim.scenario.consistency import cross_faults
from zsim.scenario.scenario import DRONES_MAX, Document, Scenario
from zsim.scenario.shared_vehicle import shared, upon
from zsim.schema import plugin, yaml_file
from zsim.schema.checker import Fault, faults, first_lines, show, sound
from zsim.sensors.error_units import in_channel_units
from zsim.sensors.sensor_catalogue import AS_PRINTED, PRESETS, STOCK, Sensors, flattened, separate
from zsim.vehicles import vehicle_catalogue
from zsim.vehicles.vehicle import DEFAULTS, Aerodynamics, Vehicle

EXAMPLE = "scenarios/step.yaml"  # named to whoever gives no scenario


def load(path: str | Path, overrides: Iterable[str] = (), modules: Iterable[Path] = (), **values: Any) -> Scenario:
    """Return the resolved scenario of a YAML file; classes that it names may stand in modules beside it.

    Args:
        path: the file.
        overrides: texts `a.b.c=value` as given to `--set`, applied in order.
        modules: further folders in which the modules may stand.
        values: top-level fields that replace the file's, None being ignored (`seed=3`).

    Raises:
        ScenarioError: with every fault found, a line each.
    """
    path = Path(path)
    plugin.search(path.parent, *modules)
    document = yaml_file.read(path, EXAMPLE, ScenarioError)
    document.update({key: value for key, value in values.items() if value is not None})
    applied = [override.apply_override(document, text, yaml_file.value) for text in overrides]
    return _resolve(document, path.name, [fault for fault in applied if fault])


def resolve(document: dict[str, Any], source: str = "scenario") -> Scenario:
    """Return the scenario of a raw document: presets expanded, everything checked.

    Raises:
        ScenarioError: with every fault found, a line each.
    """
    return _resolve(document, source, [])


def _resolve(document: dict[str, Any], source: str, lines: list[str], imports: bool = True) -> Scenario:
    document = _share_vehicle(document)
    document, misread = _in_channel_units(document)
    vehicles, unknown = _vehicles(document, imports)
    document, unsound = _separate_sensors(_expand_presets(document, vehicles), imports)
    between = cross_faults(sound(document, Scenario), vehicles)
    flaws = chain(misread, faults(document, Document), unknown, unsound, between)
    found = first_lines(chain(lines, (f"{source}: {path} {text}{_whose(document, path)}" for path, text in flaws)))
    if found:
        raise ScenarioError(found)
    del document["sensors"]
    document.pop("vehicle", None)
    return msgspec.convert(document, Scenario)


def from_text(text: str) -> Scenario:
    """Return the scenario that `world/info` carries; nothing that it names is imported.

    Raises:
        ScenarioError: with every fault found, a line each.
    """
    source = "world/info"
    return _resolve(yaml_file.parse(text, source, EXAMPLE, ScenarioError), source, [], imports=False)


def to_text(scenario: Scenario) -> str:
    """Return the resolved scenario as YAML text; the same scenario gives the same text."""
    document = msgspec.to_builtins(scenario)
    for drone in document["drones"]:
        drone["sensors"] = flattened(drone["sensors"])
    return yaml_file.dump(document)


def sha256(text: str) -> str:
    """Return the hash that names a resolved scenario, from its text."""
    return hashlib.sha256(text.encode()).hexdigest()


def _share_vehicle(document: dict[str, Any]) -> dict[str, Any]:
    """Return a document whose drones have what its `vehicle:` says, as far as they say nothing else."""
    drones, fields = document.get("drones"), shared(document)
    if not fields or not isinstance(drones, list) or len(drones) > DRONES_MAX:
        return document
    return {**document, "drones": [upon(fields, drone) for drone in drones]}


def _in_channel_units(document: dict[str, Any]) -> tuple[dict[str, Any], list[Fault]]:
    """Return a document whose sensors' errors are in the units of their channels, and where they cannot be read."""
    misread: list[Fault] = []
    read = _with_units(document, "sensors", misread)
    drones = document.get("drones")
    if isinstance(drones, list) and len(drones) <= DRONES_MAX:
        read = {**read, "drones": [_with_units(d, f"drones[{i}].sensors", misread) for i, d in enumerate(drones)]}
    return read, misread


def _with_units(section: Any, where: str, misread: list[Fault]) -> Any:
    if not isinstance(section, dict) or not isinstance(section.get("sensors"), dict):
        return section
    sensors, wrong = in_channel_units(section["sensors"], STOCK, where)
    misread += wrong
    return {**section, "sensors": sensors}


def _vehicles(document: dict[str, Any], imports: bool) -> tuple[dict[str, Vehicle], list[Fault]]:
    """Return the vehicles that drones of a document need, by model, and where a model is none.

    A drone with all its numbers, as in a resolved scenario, needs no module of a user's: whoever reads `world/info`
    imports nothing that it names. One that must not be imported is left out.
    """
    vehicles, unknown = dict(vehicle_catalogue.STOCK), []
    drones = document.get("drones")
    entries = drones if isinstance(drones, list) and len(drones) <= DRONES_MAX else []
    for index, drone in enumerate(entries):
        model = drone.get("model") if isinstance(drone, dict) else None
        if isinstance(model, str) and model not in vehicles and not _is_resolved(drone):
            if not imports:
                allowed = f"must be {', '.join(vehicle_catalogue.STOCK)}, or come with all its numbers"
                unknown.append((f"drones[{index}].model", f"is {show(model)}; {allowed}"))
                continue
            try:
                vehicles[model] = vehicle_catalogue.vehicle_of(model, "")
            except NotTrustedError:
                continue
            except DocumentError as error:
                unknown += [(f"drones[{index}].model", line.strip()) for line in error.faults]
    return vehicles, unknown


def _is_resolved(drone: dict[str, Any]) -> bool:
    return all(name in drone for name in (*DEFAULTS, "limits", "sensors"))


def _expand_presets(document: dict[str, Any], vehicles: dict[str, Vehicle]) -> dict[str, Any]:
    """Put preset, the scenario's `sensors:` and the drone's `sensors:` together, the later ones winning.

    A faulty part of the scenario's is not handed on to the drones: its faults are shown once.
    """
    shared = document.get("sensors") or {}
    document = {**document, "sensors": _expanded(shared)}
    faulty = {path.partition(".")[0] for path, _ in _sensor_faults(document["sensors"])}
    usable = {} if "" in faulty else {name: value for name, value in shared.items() if name not in faulty}
    drones = document.get("drones")
    if isinstance(drones, list) and len(drones) <= DRONES_MAX:
        document["drones"] = [_expand_drone(drone, usable, vehicles) for drone in drones]
    return document


def _sensor_faults(section: Any) -> Iterator[Fault]:
    """Yield the faults of an expanded `sensors:` section."""
    if isinstance(section, dict):
        rest, _, unsound = separate(section)
        yield from unsound
        section = rest
    yield from faults(section, Sensors)


def _separate_sensors(document: dict[str, Any], imports: bool) -> tuple[dict[str, Any], list[Fault]]:
    """Return a document with the users' sensors apart from the stock ones, and what is wrong with them."""
    unsound: list[Fault] = []
    section = _separated(document["sensors"], "sensors", unsound, imports)
    drones = document.get("drones")
    if isinstance(drones, list) and len(drones) <= DRONES_MAX:
        drones = [
            {**drone, "sensors": _separated(drone["sensors"], f"drones[{index}].sensors", unsound, imports)}
            if isinstance(drone, dict)
            else drone
            for index, drone in enumerate(drones)
        ]
        return {**document, "sensors": section, "drones": drones}, unsound
    return {**document, "sensors": section}, unsound


def _separated(section: Any, where: str, unsound: list[Fault], imports: bool) -> Any:
    if not isinstance(section, dict):
        return section
    rest, own, wrong = separate(section, imports)
    unsound += [(f"{where}.{path}", text) for path, text in wrong]
    return {**rest, "own": own} if own else rest


def _expand_drone(drone: Any, shared: dict[str, Any], vehicles: dict[str, Vehicle]) -> Any:
    """Put what a drone says on top of its vehicle's numbers and of the sensors that all share."""
    if not isinstance(drone, dict):
        return drone
    model = drone.get("model", vehicle_catalogue.DEFAULT)
    vehicle = vehicles.get(model) if isinstance(model, str) else None
    vehicle = vehicle or vehicles[vehicle_catalogue.DEFAULT]
    own = drone.get("sensors")
    own_sensors = _merge(shared, own) if isinstance(own, dict) else shared if own is None else own
    sections = {"limits": msgspec.to_builtins(vehicle.limits)}
    if vehicle.aerodynamics != Aerodynamics():
        sections["aerodynamics"] = msgspec.to_builtins(vehicle.aerodynamics)
    defaults = {name: getattr(vehicle, name) for name in DEFAULTS} | sections
    merged = {name: _merge(sections[name], drone[name]) for name in sections if _has_map(drone, name)}
    return {**defaults, **drone, "sensors": _expanded(own_sensors, vehicle.sensor_preset), **merged}


def _has_map(section: dict[str, Any], name: str) -> bool:
    return isinstance(section.get(name), dict)


def _expanded(sensors: Any, default: str = vehicle_catalogue.STOCK[vehicle_catalogue.DEFAULT].sensor_preset) -> Any:
    """Return a `sensors:` section upon its preset."""
    if not isinstance(sensors, dict):
        return sensors
    name = sensors.get("preset", default)
    preset = PRESETS.get(name, PRESETS[default]) if isinstance(name, str) else PRESETS[default]
    if sensors.get("as_printed") is True and name == "paper":
        preset = _merge(preset, AS_PRINTED)
    return _merge({"preset": name, **preset}, sensors)


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _whose(document: dict[str, Any], path: str) -> str:
    """Return " (drone 'drone3')" for a path inside a drone's entry, the like for a cluster's."""
    match = re.match(r"(drone|cluster)s\[(\d+)\]", path)
    entries = document.get(f"{match[1]}s") if match else None
    if not match or not isinstance(entries, Sequence):
        return ""
    entry = entries[int(match[2])]
    name = entry.get("name") if isinstance(entry, dict) else None
    return f" ({match[1]} {name!r})" if isinstance(name, str) and len(name) <= 40 else ""
