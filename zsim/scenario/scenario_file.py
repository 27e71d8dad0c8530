"""Scenario files: reading, overrides, resolution, checks, and the text of `world/info`."""

import copy
import csv
import hashlib
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, get_args

import msgspec
from msgspec import Struct, structs

from zsim.errors import DocumentError, NotTrustedError, ScenarioError
from zsim.scenario import own_classes
from zsim.scenario.consistency import cross_faults
from zsim.scenario.generated import with_generated
from zsim.scenario.scenario import DRONES_MAX, VEHICLE_NUMBERS, Document, Scenario, SharedVehicle, Topology
from zsim.schema import plugin, yaml_file
from zsim.schema.checker import Fault, faults, faults_in, first_lines, show, sound, suggestion
from zsim.sensors.sensor_catalogue import AS_PRINTED, PRESETS, Sensors, flattened, in_channel_units, separate
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim.vehicles.vehicle import DEFAULT_MODEL, MODELS, Aerodynamics, Vehicle, vehicle_of

EXAMPLE = "scenarios/step.yaml"  # example of a scenario, named in errors
SYNTAX = "a.b.c=value, e.g. drones.drone2.mass_kg=0.5 or environment.wind.gust_m_s=0.5"
PATH_MAX = 1000  # characters; ten times the longest path in a scenario
NOTHING: Mapping[str, Any] = {}
_STEP = re.compile(r"([^.\[\]]+)|\[([^\[\]]+)\]")  # one step of a path: a word, or anything in brackets
_FIRST = re.compile(r"[^.\[\]]+")
_PATH = re.compile(r"([^.\[\]]+|\[[^\[\]]+\])(\.[^.\[\]]+|\[[^\[\]]+\])*")
AXES = ("x", "y", "z", "yaw")
TERMS = 8
HEADER = ("duration", *(f"{axis}^{power}" for axis in AXES for power in range(TERMS)))
BYTES_MAX = 2_000_000  # bytes; about the size of a file with five thousand pieces


def load(
    path: str | Path,
    overrides: Iterable[str] = (),
    modules: Iterable[Path] = (),
    imports: bool = True,
    **values: Any,
) -> Scenario:
    """Return the resolved scenario of a YAML file; the classes that it names may be in modules in its folder.

    Args:
        overrides: texts `a.b.c=value` as given to `--set`, applied in order.
        modules: further folders with modules.
        imports: whether to import the named modules; not needed for a resolved file.
        values: top-level fields that replace the file's (`seed=3`); None is ignored.

    Raises:
        ScenarioError: the scenario has faults; a line for each.
    """
    path = Path(path)
    plugin.search(path.parent, *modules)
    document = yaml_file.read(path, EXAMPLE, ScenarioError)
    document.update({key: value for key, value in values.items() if value is not None})
    applied = [apply_override(document, text, yaml_file.value) for text in overrides]
    return _resolve(document, path.name, [fault for fault in applied if fault], imports)


def resolve(document: dict[str, Any], source: str = "scenario") -> Scenario:
    """Return the scenario of a raw document, with presets expanded and everything checked. Errors as for `load`."""
    return _resolve(document, source, [])


def from_text(text: str) -> Scenario:
    """Return the scenario in `world/info`, without importing anything that it names. Errors as for `load`."""
    source = "world/info"
    return _resolve(yaml_file.parse(text, source, EXAMPLE, ScenarioError), source, [], imports=False)


def to_text(scenario: Scenario) -> str:
    """Return the resolved scenario as YAML text; the same scenario gives the same text."""
    document = msgspec.to_builtins(scenario)
    for drone in document["drones"]:
        drone["sensors"] = flattened(drone["sensors"])
    return yaml_file.dump(document)


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _resolve(document: dict[str, Any], source: str, lines: list[str], imports: bool = True) -> Scenario:
    """Return the scenario of a raw document; `lines` are faults found earlier.

    A drone's own fields take precedence over the document's `vehicle:`, and those over the numbers of its model;
    likewise the drone's own `sensors:` over the document's, and those over the preset. Faulty parts of the shared
    sections are not passed to the drones, so that their faults are reported only once.
    """
    misread: list[Fault] = []  # sensor error models with unreadable units
    unknown: list[Fault] = []  # drone models that are not vehicles
    unsound: list[Fault] = []  # faults of users' sensors, classes, files and generated obstacles
    unread: set[str] = set()  # names of users' sensors that are faulty, or must not be imported
    vehicles = {name: vehicle_of(name) for name in MODELS}  # by model

    section = _in_channel_units(document.get("sensors"), "sensors", misread)
    shared_sensors = section or {}
    sensors = _with_preset(shared_sensors, ARDRONE2.sensor_preset)
    stock, _, wrong = separate(sensors) if isinstance(sensors, dict) else (sensors, {}, [])
    faulty = {path.partition(".")[0] for path, _ in (*wrong, *faults(stock, Sensors))}
    usable = {} if "" in faulty else {name: each for name, each in shared_sensors.items() if name not in faulty}
    shared_vehicle = document.get("vehicle")
    if isinstance(shared_vehicle, dict):
        faulty = {path.partition(".")[0].partition("[")[0] for path, _ in faults(shared_vehicle, SharedVehicle)}
        shared_vehicle = {name: value for name, value in shared_vehicle.items() if name not in faulty}
    else:
        shared_vehicle = {}

    def resolved_drone(drone: Any, where: str) -> Any:
        if not isinstance(drone, dict):
            return drone
        drone = with_defaults(shared_vehicle, drone)
        vehicle = _vehicle_of(drone, f"{where}.model", vehicles, unknown, imports)
        own = _in_channel_units(drone.get("sensors"), f"{where}.sensors", misread)
        own = with_defaults(usable, own) if isinstance(own, dict) else usable if own is None else own
        own = _separated(_with_preset(own, vehicle.sensor_preset), f"{where}.sensors", unsound, unread, imports)
        numbers = {name: getattr(vehicle, name) for name in VEHICLE_NUMBERS}
        numbers["limits"] = msgspec.to_builtins(vehicle.limits)
        if vehicle.aerodynamics != Aerodynamics():  # otherwise left out of the resolved text
            numbers["aerodynamics"] = msgspec.to_builtins(vehicle.aerodynamics)
        if "reference" in drone:
            drone = {**drone, "reference": _with_pieces(drone["reference"], f"{where}.reference", unsound)}
        return {**with_defaults(numbers, drone), "sensors": own}

    document, wrong = with_generated(document)
    unsound += wrong
    document = {**document, "sensors": _separated(sensors, "sensors", unsound, unread, imports)}
    if imports and plugin.may_import():
        document = document | {
            key: copy.deepcopy(document[key]) for key in ("clusters", "estimation") if key in document
        }
        unsound += own_classes.with_parameters(document)
    if "agents" in document:
        document["agents"], wrong = own_classes.with_agents(document["agents"], imports)
        unsound += wrong
        document["processes"] = _with_deaths(document.get("processes", {}), document["agents"], "restart")
    if "programs" in document:
        document["processes"] = _with_deaths(document.get("processes", {}), document["programs"], "end")
    shortened = _is_graph(document.get("topology"))
    if shortened:
        document["topology"] = {"graph": document["topology"]}
    drones = document.get("drones")
    if isinstance(drones, list) and len(drones) <= DRONES_MAX:
        document["drones"] = [resolved_drone(drone, f"drones[{index}]") for index, drone in enumerate(drones)]

    between = cross_faults(sound(document, Scenario), vehicles, unread)
    flaws = chain(misread, faults(document, Document), unknown, unsound, between)
    if shortened:
        flaws = ((re.sub(r"^topology\.graph", "topology", path), text) for path, text in flaws)
    errors = first_lines(chain(lines, (f"{source}: {path} {text}{_owner(document, path)}" for path, text in flaws)))
    if errors:
        raise ScenarioError(errors)
    del document["sensors"]
    document.pop("vehicle", None)
    return msgspec.convert(document, Scenario)


def with_defaults(base: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in overrides.items():
        are_maps = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = with_defaults(merged[key], value) if are_maps else value
    return merged


def _in_channel_units(sensors: Any, where: str, misread: list[Fault]) -> Any:
    """Return a `sensors:` section with error models converted to the units of their channels."""
    if not isinstance(sensors, dict):
        return sensors
    read, wrong = in_channel_units(sensors, where)
    misread += wrong
    return read


def _with_preset(sensors: Any, default: str) -> Any:
    """Return a `sensors:` section completed from its preset, or from the default one."""
    if not isinstance(sensors, dict):
        return sensors
    name = sensors.get("preset", default)
    preset = PRESETS.get(name, PRESETS[default]) if isinstance(name, str) else PRESETS[default]
    if sensors.get("as_printed") is True and name == "paper":
        preset = with_defaults(preset, AS_PRINTED)
    return with_defaults({"preset": name, **preset}, sensors)


def _separated(section: Any, where: str, unsound: list[Fault], unread: set[str], imports: bool) -> Any:
    """Return a `sensors:` section with the users' sensors moved into `own`."""
    if not isinstance(section, dict):
        return section
    stock, own, wrong = separate(section, imports)
    unsound += [(f"{where}.{path}", text) for path, text in wrong]
    unread |= section.keys() - stock.keys() - own.keys()
    return {**stock, "own": own} if own else stock


def _with_pieces(reference: Any, where: str, unsound: list[Fault]) -> Any:
    """Return a drone's reference with its file, in the scenario's folder or the current one, replaced by the pieces."""
    name = reference.get("file") if isinstance(reference, dict) else None
    if not isinstance(name, str):
        return reference
    if "pieces" in reference:
        unsound.append((f"{where}.file", "is given together with pieces; give only one of them"))
        return reference
    try:
        pieces = pieces_of(plugin.beside(name), f"{where}.file")
    except DocumentError as error:
        unsound += faults_in(error)
        return reference
    return {**{key: value for key, value in reference.items() if key != "file"}, "pieces": pieces}


def _is_graph(topology: Any) -> bool:
    """Return whether a `topology:` section is only a graph: a name, or lists of the drones that each drone hears."""
    if isinstance(topology, dict):
        has_lists = any(isinstance(senders, list) for senders in topology.values())
        return has_lists and not topology.keys() & set(Topology.__struct_fields__)
    return isinstance(topology, str)


def _with_deaths(processes: Any, own: Any, action: str) -> Any:
    """Return a `processes:` section with the default `on_death` of users' roles and programs."""
    if not (isinstance(processes, dict) and isinstance(own, dict)):
        return processes
    declared = processes.get("on_death", {})
    return {**processes, "on_death": dict.fromkeys(own, action) | declared} if isinstance(declared, dict) else processes


def _vehicle_of(
    drone: dict[str, Any], where: str, vehicles: dict[str, Vehicle], unknown: list[Fault], imports: bool
) -> Vehicle:
    """Return the vehicle of a drone's model; the AR.Drone if the model is unknown or must not be imported.

    A drone with all its numbers, as in a resolved scenario, needs no user's module: readers of `world/info` import
    nothing.
    """
    model = drone.get("model", DEFAULT_MODEL)
    if not isinstance(model, str):
        return ARDRONE2
    if model not in vehicles and not all(name in drone for name in (*VEHICLE_NUMBERS, "limits", "sensors")):
        try:
            if not imports:
                allowed = f"must be {', '.join(MODELS)}, or come with all its numbers"
                raise DocumentError([f"is {show(model)}; {allowed}"])
            vehicles[model] = vehicle_of(model, "")
        except NotTrustedError:
            pass
        except DocumentError as error:
            unknown += [(where, line.strip()) for line in error.faults]
    return vehicles.get(model, ARDRONE2)


def _owner(document: dict[str, Any], path: str) -> str:
    """Return " (drone 'drone3')" for a path inside a drone's entry, and likewise for a cluster's."""
    match = re.match(r"(drone|cluster)s\[(\d+)\]", path)
    entries = document.get(f"{match[1]}s") if match else None
    if not match or not isinstance(entries, Sequence):
        return ""
    entry = entries[int(match[2])]
    name = entry.get("name") if isinstance(entry, dict) else None
    return f" ({match[1]} {name!r})" if isinstance(name, str) and len(name) <= 40 else ""


# Overrides: `a.b.c=value`, with list entries by index or name


def apply_override(document: dict[str, Any], text: str, parse: Callable[[str], Any]) -> str | None:
    """Apply one override to a raw document; if it is faulty, return the fault and change nothing.

    Args:
        document: modified in place.
        text: the override, e.g. "drones[2].yaw_deg=90".
        parse: converts the text of a value; its ValueError becomes the fault.
    """
    path, equals, value_text = text.partition("=")
    fault: object = None
    if len(path) > PATH_MAX:
        fault = f"is a path of {len(path)} characters; must have at most {PATH_MAX}"
    elif not equals or not _PATH.fullmatch(path):
        fault = f"is not an assignment; must be {SYNTAX}"
    else:
        try:
            _assign(document, steps_of(path, document), parse(value_text))
        except ValueError as error:
            fault = error
    shown = text if len(text) <= 80 and text.isprintable() else show(text)
    return None if fault is None else f"--set {shown}: {fault}"


def steps_of(path: str, document: Mapping[str, Any] = NOTHING) -> list[str]:
    """Return the steps of a path from the top of a scenario: fields, and entries by index or name.

    Arguments and errors as for `full_path`.
    """
    return [name or bracket for name, bracket in _STEP.findall(full_path(path, document))]


def full_path(path: str, document: Mapping[str, Any] = NOTHING) -> str:
    """Return the full path of a field in a raw document.

    The name of a section may be omitted if only one section has such a field: wind.gust_m_s stands for
    environment.wind.gust_m_s. The name of a list and its entry may be omitted if the list has one entry:
    gains.proportional_1_s stands for clusters.main.gains.proportional_1_s.

    Raises:
        ValueError: the field belongs to a list of sections with several entries.
    """
    first = _FIRST.match(path)
    sections = {field.name: field.type for field in _fields(Document)}
    if first is None or first[0] in sections:
        return path

    def has_field(kind: Any) -> bool:
        return any(field.name == first[0] for field in _fields(kind))

    owners = [name for name, kind in sections.items() if has_field(kind)]
    if owners:
        return f"{owners[0]}.{path}" if len(owners) == 1 else path
    lists = [name for name, kind in sections.items() if any(map(has_field, get_args(kind)))]
    entries = document.get(lists[0]) if len(lists) == 1 else None
    if not isinstance(entries, list) or not entries:
        return path
    section, entry = lists[0], entries[0]
    name = entry.get("name") if isinstance(entry, dict) else None
    prefix = f"{section}.{name}" if isinstance(name, str) and _FIRST.fullmatch(name) else f"{section}[0]"
    if len(entries) > 1:
        raise ValueError(f"is a field of each of {len(entries)} {section}; give the full path, e.g. {prefix}.{path}")
    return f"{prefix}.{path}"


@cache
def _fields(kind: Any) -> Sequence[Any]:
    """Return the fields of a section or optional section; none for any other type."""
    sections = [each for each in (kind, *get_args(kind)) if isinstance(each, type) and issubclass(each, Struct)]
    return structs.fields(sections[0]) if sections else ()


def _assign(document: dict[str, Any], steps: list[str], value: Any) -> None:
    """Set the value at a path, creating missing or empty sections along it."""
    node: Any = document
    for depth, step in enumerate(steps):
        if not isinstance(node, dict | list):
            raise ValueError(f"{'.'.join(steps[:depth])} is {show(node)}; must be a map or a list")
        key: Any = step
        if isinstance(node, list):
            names = [item.get("name") if isinstance(item, dict) else None for item in node]
            if step in names:
                key = names.index(step)
            elif re.fullmatch(r"[0-9]{1,9}", step) and int(step) < len(node):
                key = int(step)
            else:
                item_names = [name for name in names if isinstance(name, str)]
                choices = f"0 to {len(node) - 1}{' or ' if item_names else ''}{', '.join(item_names)}"
                allowed = f"{suggestion(step, item_names)}allowed: {choices if node else 'nothing, it is empty'}"
                raise ValueError(f"{step[:40]} is not in {'.'.join(steps[:depth])}; {allowed}")
        if depth == len(steps) - 1:
            node[key] = value
        elif isinstance(node, dict) and node.get(key) is None:
            node[key] = {}
        node = node[key]


def pieces_of(path: Path, where: str) -> list[dict[str, Any]]:
    """Return the polynomial pieces in a file as in a scenario: `duration_s`, and lists `x`, `y`, `z`, `yaw`.

    The format is that of uav_trajectories and Crazyswarm: a header line, then for each piece a line of 33 numbers: its
    duration [s], and the coefficients of t^0 to t^7 for x, y, z [m] and yaw [rad], where t is the time since the piece
    began. https://github.com/whoenig/uav_trajectories

    Args:
        where: path of the field that names the file.

    Raises:
        DocumentError: the file cannot be read, or has invalid pieces; a line for each.
    """
    try:
        if path.stat().st_size > BYTES_MAX:
            raise DocumentError(
                [f"{where} is {show(str(path))}, which has more than {BYTES_MAX} bytes; must have at most that many"]
            )
        rows = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DocumentError([f"{where} is {show(str(path))}, which cannot be read ({error})"]) from error
    rows = [_without_end([cell.strip() for cell in row]) for row in rows]
    header = tuple(cell.lower().replace(" ", "") for cell in rows[0]) if rows else ()
    if header != HEADER:
        needed = f"must begin with the header duration, x^0 to x^7, y^0, …, yaw^7: {len(HEADER)} columns"
        raise DocumentError([f"{where} is {show(str(path))}, whose header differs; {needed}"])
    pieces, wrong = [], []
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        try:
            numbers = [float(cell) for cell in row]
        except ValueError:
            numbers = []
        if len(numbers) != len(HEADER) or not all(map(math.isfinite, numbers)):
            problem = f"has {len(row)} entries: {', '.join(row)[:40]}"
            wrong.append(f"{where} is {show(str(path))}, whose line {number} {problem}; must be {len(HEADER)} numbers")
            continue
        axes = {axis: numbers[1 + k * TERMS : 1 + (k + 1) * TERMS] for k, axis in enumerate(AXES)}
        pieces.append({"duration_s": numbers[0], **axes})
    if wrong or not pieces:
        raise DocumentError(wrong or [f"{where} is {show(str(path))}, which has no pieces; must have one or more"])
    return pieces


def _without_end(row: list[str]) -> list[str]:
    """Return a row without empty cells at its end: Crazyswarm's files have a trailing comma."""
    while row and not row[-1]:
        row.pop()
    return row
