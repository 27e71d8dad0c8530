"""Scenario files: read, override, resolve, check, and write out again as the text of `world/info`."""

import hashlib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import msgspec
import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from zsim import overrides as override
from zsim.cross_faults import cross_faults
from zsim.errors import ScenarioError
from zsim.faults import faults, show, sound
from zsim.presets import AS_PRINTED, PRESETS
from zsim.scenario import DRONES_MAX, Document, Scenario, Sensors

FILE_SIZE_MAX = 1_000_000  # bytes; a scenario of 1000 drones with every field given is below this
FAULTS_MAX = 100  # lines; what follows is counted


def load(path: str | Path, overrides: Iterable[str] = (), **values: Any) -> Scenario:
    """Return the resolved scenario of a YAML file.

    Args:
        path: the file.
        overrides: texts `a.b.c=value` as given to `--set`, applied in order.
        values: top-level fields that replace the file's, None being ignored (`seed=3`).

    Raises:
        ScenarioError: with every fault found, a line each.
    """
    path = Path(path)
    document = _read(path)
    document.update({key: value for key, value in values.items() if value is not None})
    applied = [override.apply(document, text, _value) for text in overrides]
    return _resolve(document, path.name, [fault for fault in applied if fault])


def resolve(document: dict[str, Any], source: str = "scenario") -> Scenario:
    """Return the scenario of a raw document: presets expanded, everything checked.

    Raises:
        ScenarioError: with every fault found, a line each.
    """
    return _resolve(document, source, [])


def _resolve(document: dict[str, Any], source: str, lines: list[str]) -> Scenario:
    document = _expand_presets(document)
    found = [*faults(document, Document), *cross_faults(sound(document, Scenario))]
    lines += [f"{source}: {path} {text}{_whose(document, path)}" for path, text in found]
    if lines:
        raise ScenarioError(_shortened(lines))
    del document["sensors"]
    return msgspec.convert(document, Scenario)


def _shortened(lines: list[str]) -> list[str]:
    more = len(lines) - FAULTS_MAX
    return [*lines[:FAULTS_MAX], f"… and {more} more faults"] if more > 0 else lines


def from_text(text: str) -> Scenario:
    """Return the scenario that `world/info` carries."""
    return resolve(_parse(text, "world/info"), source="world/info")


def to_text(scenario: Scenario) -> str:
    """Return the resolved scenario as YAML text; the same scenario gives the same text."""
    plain = msgspec.to_builtins(scenario)
    return yaml.dump(plain, Dumper=_Dumper, sort_keys=True, default_flow_style=None, width=120)


def sha256(scenario: Scenario) -> str:
    """Return the hash that names a resolved scenario."""
    return hashlib.sha256(to_text(scenario).encode()).hexdigest()


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            content = file.read(FILE_SIZE_MAX + 1)
        text = content.decode("utf-8-sig")
    except OSError as error:
        reason = error.strerror or str(error)
        raise ScenarioError([f"{path}: cannot be read ({reason}); give the path of a YAML file"]) from error
    except UnicodeDecodeError as error:
        raise ScenarioError([f"{path}: is not text (byte {error.start}); must be YAML in UTF-8"]) from error
    except ValueError as error:
        raise ScenarioError([f"{show(str(path))}: is no path ({error}); give that of a YAML file"]) from error
    if len(content) > FILE_SIZE_MAX:
        raise ScenarioError([f"{path}: is larger than {FILE_SIZE_MAX} bytes; must be at most that"])
    return _parse(text, path.name)


def _parse(text: str, source: str) -> dict[str, Any]:
    try:
        document = _value(text)
    except ValueError as error:
        raise ScenarioError([f"{source}: {error}; see scenarios/step.yaml"]) from error
    if not isinstance(document, dict):
        raise ScenarioError([f"{source}: holds {show(document)}; must be a map as in scenarios/step.yaml"])
    return document


def _value(text: str) -> Any:
    """Return what a YAML text says; ValueError, a line long, if it says nothing."""
    try:
        return yaml.load(text, Loader=_Loader)
    except RecursionError:
        raise ValueError("is nested too deep") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1} " if mark else ""
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ValueError(f"{where}is not YAML ({problem[:100]})") from error


class _Loader(yaml.SafeLoader):
    """YAML 1.2 floats (1e3 is a number); no aliases, for a bomb is made of them, and no tags."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            raise ComposerError(None, None, "aliases are not allowed", cast(Any, event.start_mark))
        if getattr(event, "tag", None) is not None:
            raise ComposerError(None, None, "tags are not allowed", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str) and key in seen:
                raise ConstructorError(None, None, f"key {show(key)} is given twice", key_node.start_mark)
            seen.add(key if isinstance(key, str) else None)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Puts into quotes the texts that `_Loader` would read as numbers."""


for _yaml in (_Loader, _Dumper):
    _yaml.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^[-+]?\.(inf|Inf)$|^\.(nan|NaN)$"),
        list("-+0123456789."),
    )


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
    given = _merge(shared, own) if isinstance(own, dict) else shared if own is None else own
    return {**drone, "sensors": _expanded(given)}


def _expanded(given: Any) -> Any:
    """Return a `sensors:` section upon its preset."""
    if not isinstance(given, dict):
        return given
    name = given.get("preset", "ardrone2")
    preset = PRESETS.get(name, PRESETS["ardrone2"]) if isinstance(name, str) else PRESETS["ardrone2"]
    if given.get("as_printed") is True and name == "paper":
        preset = _merge(preset, AS_PRINTED)
    return _merge({"preset": name, **preset}, given)


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
