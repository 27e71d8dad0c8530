"""Scenario files: read, override, resolve, check, and write out again as the text of `world/info`."""

import hashlib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from zsim.errors import ScenarioError
from zsim.scenario import overrides as override
from zsim.scenario.consistency import cross_faults
from zsim.scenario.scenario import DRONES_MAX, Document, Scenario, Sensors
from zsim.scenario.sensor_presets import AS_PRINTED, PRESETS
from zsim.schema import plugin, yaml_file
from zsim.schema.checker import faults, sound

EXAMPLE = "scenarios/step.yaml"  # named to whoever gives no scenario
FAULTS_MAX = 100  # lines; what follows is counted


def load(path: str | Path, overrides: Iterable[str] = (), **values: Any) -> Scenario:
    """Return the resolved scenario of a YAML file; classes that it names may stand in modules beside it.

    Args:
        path: the file.
        overrides: texts `a.b.c=value` as given to `--set`, applied in order.
        values: top-level fields that replace the file's, None being ignored (`seed=3`).

    Raises:
        ScenarioError: with every fault found, a line each.
    """
    path = Path(path)
    plugin.search(path.parent)
    document = yaml_file.read(path, EXAMPLE, ScenarioError)
    document.update({key: value for key, value in values.items() if value is not None})
    applied = [override.apply(document, text, yaml_file.value) for text in overrides]
    return _resolve(document, path.name, [fault for fault in applied if fault])


def resolve(document: dict[str, Any], source: str = "scenario") -> Scenario:
    """Return the scenario of a raw document: presets expanded, everything checked.

    Raises:
        ScenarioError: with every fault found, a line each.
    """
    return _resolve(document, source, [])


def _resolve(document: dict[str, Any], source: str, lines: list[str]) -> Scenario:
    document = _expand_presets(document)
    flaws = [*faults(document, Document), *cross_faults(sound(document, Scenario))]
    lines += [f"{source}: {path} {text}{_whose(document, path)}" for path, text in flaws]
    if lines:
        raise ScenarioError(_shortened(lines))
    del document["sensors"]
    return msgspec.convert(document, Scenario)


def _shortened(lines: list[str]) -> list[str]:
    more = len(lines) - FAULTS_MAX
    return [*lines[:FAULTS_MAX], f"… and {more} more faults"] if more > 0 else lines


def from_text(text: str) -> Scenario:
    """Return the scenario that `world/info` carries."""
    return resolve(yaml_file.parse(text, "world/info", EXAMPLE, ScenarioError), source="world/info")


def to_text(scenario: Scenario) -> str:
    """Return the resolved scenario as YAML text; the same scenario gives the same text."""
    return yaml_file.dump(msgspec.to_builtins(scenario))


def sha256(text: str) -> str:
    """Return the hash that names a resolved scenario, from its text."""
    return hashlib.sha256(text.encode()).hexdigest()


def _expand_presets(document: dict[str, Any]) -> dict[str, Any]:
    """Put preset, the scenario's `sensors:` and the drone's `sensors:` together, the later ones winning.

    A faulty section of the scenario is not handed on to the drones: its faults are told once.
    """
    shared = document.get("sensors") or {}
    document = {**document, "sensors": _expanded(shared)}
    usable = {} if any(faults(document["sensors"], Sensors)) else shared
    drones = document.get("drones")
    if isinstance(drones, list) and len(drones) <= DRONES_MAX:
        document["drones"] = [_expand_drone(drone, usable) for drone in drones]
    return document


def _expand_drone(drone: Any, shared: dict[str, Any]) -> Any:
    if not isinstance(drone, dict):
        return drone
    own = drone.get("sensors")
    own_sensors = _merge(shared, own) if isinstance(own, dict) else shared if own is None else own
    return {**drone, "sensors": _expanded(own_sensors)}


def _expanded(sensors: Any) -> Any:
    """Return a `sensors:` section upon its preset."""
    if not isinstance(sensors, dict):
        return sensors
    name = sensors.get("preset", "ardrone2")
    preset = PRESETS.get(name, PRESETS["ardrone2"]) if isinstance(name, str) else PRESETS["ardrone2"]
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
