"""Scenario files: read, override, resolve, check, and write out again as the text of `world/info`."""

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, get_args

import msgspec
from msgspec import Struct, structs

from zsim.errors import DocumentError, NotTrustedError, ScenarioError
from zsim.scenario.consistency import cross_faults
from zsim.scenario.scenario import DRONES_MAX, Document, Scenario
from zsim.scenario.shared_vehicle import shared, upon
from zsim.schema import plugin, yaml_file
from zsim.schema.checker import Fault, faults, first_lines, show, sound, suggestion
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
    applied = [apply_override(document, text, yaml_file.value) for text in overrides]
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


SYNTAX = "a.b.c=value, e.g. drones.drone2.mass_kg=0.5 or environment.wind.gust_m_s=0.5"
PATH_MAX = 1000  # characters; the longest of a scenario has a tenth of that
NOTHING: Mapping[str, Any] = {}
_STEP = re.compile(r"([^.\[\]]+)|\[([^\[\]]+)\]")  # one step of a path: a word, or anything between brackets
_FIRST = re.compile(r"[^.\[\]]+")
_PATH = re.compile(r"([^.\[\]]+|\[[^\[\]]+\])(\.[^.\[\]]+|\[[^\[\]]+\])*")


def apply_override(document: dict[str, Any], text: str, parse: Callable[[str], Any]) -> str | None:
    """Apply one override to a raw document; return the fault if there is one, and then nothing has changed.

    Args:
        document: changed in place.
        text: as given, e.g. "drones[2].yaw_deg=90".
        parse: turns the text of a value into the value; its ValueError says what is wrong.
    """
    path, equals, value_text = text.partition("=")
    if len(path) > PATH_MAX:
        return f"{_shown_override(text)}: is a path of {len(path)} characters; must have at most {PATH_MAX}"
    if not equals or not _PATH.fullmatch(path):
        return f"{_shown_override(text)}: is no assignment; must be {SYNTAX}"
    try:
        _assign(document, steps_of(path, document), parse(value_text))
    except ValueError as error:
        return f"{_shown_override(text)}: {error}"
    return None


def steps_of(path: str, document: Mapping[str, Any] = NOTHING) -> list[str]:
    """Return the steps of a path from the top of a scenario: fields, and entries by place or by name.

    Arguments and errors as `whole_path`.
    """
    return [word or bracket for word, bracket in _STEP.findall(whole_path(path, document))]


def whole_path(path: str, document: Mapping[str, Any] = NOTHING) -> str:
    """Return the path of a field from the top of a scenario.

    The name of a section may be left out where only one section has such a field: wind.gust_m_s stands for
    environment.wind.gust_m_s. Of a list of sections it may be left out where the list has one entry:
    gains.proportional_1_s stands for clusters.main.gains.proportional_1_s.

    Args:
        path: as given.
        document: the scenario that is meant, raw.

    Raises:
        ValueError: the field is one of a list of sections, of which the document has several.
    """
    first = _FIRST.match(path)
    sections = {field.name: field for field in _fields(Document)}
    if first is None or first[0] in sections:
        return path
    owners = [name for name, field in sections.items() if first[0] in _field_names(field.type)]
    if owners:
        return f"{owners[0]}.{path}" if len(owners) == 1 else path
    lists = [
        name for name, field in sections.items() if any(first[0] in _field_names(each) for each in get_args(field.type))
    ]
    return _in_entry(path, lists[0], document.get(lists[0])) if len(lists) == 1 else path


def _in_entry(path: str, section: str, entries: Any) -> str:
    """Return the path of a field of the one entry of a list, by its name if it has one."""
    if not isinstance(entries, list) or not entries:
        return path
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in entries]
    places = [f"{section}.{name}" if _is_step(name) else f"{section}[{place}]" for place, name in enumerate(names)]
    if len(places) > 1:
        raise ValueError(f"is a field of each of {len(places)} {section}; give the whole path, e.g. {places[0]}.{path}")
    return f"{places[0]}.{path}"


def _is_step(name: Any) -> bool:
    return isinstance(name, str) and _FIRST.fullmatch(name) is not None


def _field_names(kind: Any) -> list[str]:
    return [field.name for field in _fields(kind)]


@cache
def _fields(kind: Any) -> Sequence[Any]:
    """Return the fields of a section, none of any other type; a section may be one that need not be given."""
    sections = [each for each in (kind, *get_args(kind)) if isinstance(each, type) and issubclass(each, Struct)]
    return structs.fields(sections[0]) if sections else ()


def _assign(document: dict[str, Any], steps: list[str], value: Any) -> None:
    place: Any = document
    for depth, step in enumerate(steps[:-1]):
        place = _inside(place, step, steps[:depth])
    if isinstance(place, list):
        place[_index(place, steps[-1], steps[:-1])] = value
    elif isinstance(place, dict):
        place[steps[-1]] = value
    else:
        raise ValueError(f"{'.'.join(steps[:-1])} is {show(place)}; must be a map or a list")


def _inside(place: Any, step: str, path: list[str]) -> Any:
    """Return what stands at one step; a section that is not there, or empty, begins here."""
    if isinstance(place, list):
        return place[_index(place, step, path)]
    if not isinstance(place, dict):
        raise ValueError(f"{'.'.join(path)} is {show(place)}; must be a map or a list")
    if place.get(step) is None:
        place[step] = {}
    return place[step]


def _index(place: list[Any], step: str, path: list[str]) -> int:
    names = [item.get("name") if isinstance(item, dict) else None for item in place]
    if step in names:
        return names.index(step)
    if re.fullmatch(r"[0-9]{1,9}", step) and int(step) < len(place):
        return int(step)
    texts = [name for name in names if isinstance(name, str)]
    known = ", ".join(texts)
    allowed = f"0 to {len(place) - 1}{' or ' if known else ''}{known}" if place else "nothing, it is empty"
    raise ValueError(f"{step[:40]} is not in {'.'.join(path)}; {suggestion(step, texts)}allowed: {allowed}")


def _shown_override(text: str) -> str:
    return f"--set {text if len(text) <= 80 and text.isprintable() else show(text)}"
