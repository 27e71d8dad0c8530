"""Scenario files: read, override, resolve, check, and write out again as the text that `world/info` carries."""

import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from zsim.errors import ScenarioError
from zsim.faults import faults
from zsim.presets import AS_PRINTED, PRESETS
from zsim.scenario import Scenario

FILE_SIZE_MAX = 1_000_000  # bytes; a scenario of 1000 drones with every field given is below this
START_SEPARATION_MIN_M = 0.6  # m, two hulls of 0.515 m side by side (OpenMAS, weighed and measured)
OVERRIDE_SYNTAX = "a.b.c=value, e.g. drones.drone2.mass_kg=0.5 or environment.wind.gust_m_s=0.5"


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
    problems = [problem for text in overrides for problem in _override(document, text)]
    if problems:
        raise ScenarioError(problems)
    return resolve(document, source=path.name)


def resolve(document: dict[str, Any], source: str = "scenario") -> Scenario:
    """Return the scenario of a raw document: presets expanded, everything checked.

    Raises:
        ScenarioError: with every fault found, a line each.
    """
    document = _expand_presets(document)
    found = list(faults(document, Scenario))
    if not found:
        scenario = msgspec.convert(document, Scenario, strict=False)
        found = list(_cross_faults(scenario))
        if not found:
            return scenario
    raise ScenarioError([f"{source}: {path} {text}{_whose(document, path)}" for path, text in found])


def from_text(text: str) -> Scenario:
    """Return the scenario that `world/info` carries."""
    return resolve(_parse(text, "world/info"), source="world/info")


def to_text(scenario: Scenario) -> str:
    """Return the resolved scenario as YAML text; the same scenario gives the same text."""
    return yaml.safe_dump(msgspec.to_builtins(scenario), sort_keys=True, default_flow_style=None, width=120)


def sha256(scenario: Scenario) -> str:
    """Return the hash that names a resolved scenario."""
    return hashlib.sha256(to_text(scenario).encode()).hexdigest()


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > FILE_SIZE_MAX:
            raise ScenarioError([f"{path}: has {path.stat().st_size} bytes; at most {FILE_SIZE_MAX}"])
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ScenarioError([f"{path}: cannot be read ({error.strerror}); give the path of a YAML file"]) from error
    except UnicodeDecodeError as error:
        raise ScenarioError([f"{path}: is not text (byte {error.start}); must be YAML in UTF-8"]) from error
    return _parse(text, path.name)


def _parse(text: str, source: str) -> dict[str, Any]:
    try:
        document = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}" if mark else "the text"
        problem = getattr(error, "problem", None) or "nested too deep or malformed"
        raise ScenarioError([f"{source}: {where} is not YAML ({problem}); see scenarios/step.yaml"]) from error
    if not isinstance(document, dict):
        raise ScenarioError([f"{source}: holds no map; must be a map as in scenarios/step.yaml"])
    return document


class _Loader(yaml.SafeLoader):
    """YAML 1.2 floats (1e3 is a number), no aliases: a scenario is small, an alias bomb is not."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, "aliases are not allowed", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = getattr(key_node, "value", None)
            if isinstance(key, str) and key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is given twice", key_node.start_mark
                )
            seen.add(key if isinstance(key, str) else None)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^[-+]?\.(inf|Inf)$|^\.(nan|NaN)$"),
    list("-+0123456789."),
)


def _override(document: dict[str, Any], text: str) -> Iterator[str]:
    """Apply one `a.b.c=value` to the raw document; yield the fault if there is one."""
    path, equals, value = text.partition("=")
    if not equals or not path:
        yield f"--set {text}: is no assignment; must be {OVERRIDE_SYNTAX}"
        return
    parts = [part for part in re.split(r"\.|\[|\]", path) if part]
    place: Any = document
    for depth, part in enumerate(parts):
        last = depth == len(parts) - 1
        if isinstance(place, list):
            index = _index(place, part)
            if index is None:
                yield f"--set {text}: {part} is not in {'.'.join(parts[:depth])}; {_allowed(place)}"
                return
            place, part = (place, index)
        elif not isinstance(place, dict):
            yield f"--set {text}: {'.'.join(parts[:depth])} is {place!r}; must be a map or a list"
            return
        if last:
            place[part] = yaml.load(value, Loader=_Loader)
        elif isinstance(place, dict):
            place = place.setdefault(part, {})
        else:
            place = place[part]


def _index(place: list[Any], part: str) -> int | None:
    if part.isdigit() and int(part) < len(place):
        return int(part)
    names = [item.get("name") if isinstance(item, dict) else None for item in place]
    return names.index(part) if part in names else None


def _allowed(place: list[Any]) -> str:
    names = [str(item.get("name")) for item in place if isinstance(item, dict)]
    return f"allowed: 0 to {len(place) - 1}" + (f" or {', '.join(names)}" if names else "")


def _expand_presets(document: dict[str, Any]) -> dict[str, Any]:
    """Put preset, the scenario's `sensors:` and the drone's `sensors:` together, the later ones winning."""
    document = dict(document)
    shared = document.pop("sensors", {})
    drones = document.get("drones")
    if not isinstance(drones, list) or not isinstance(shared, dict):
        if not isinstance(shared, dict):
            document["sensors"] = shared
        return document
    document["drones"] = [_expand_drone(drone, shared) if isinstance(drone, dict) else drone for drone in drones]
    return document


def _expand_drone(drone: dict[str, Any], shared: dict[str, Any]) -> dict[str, Any]:
    own = drone.get("sensors", {})
    if not isinstance(own, dict):
        return drone
    given = _merge(shared, own)
    name = given.get("preset", "ardrone2")
    preset = PRESETS.get(name, PRESETS["ardrone2"]) if isinstance(name, str) else {}
    if given.get("as_printed") is True:
        preset = _merge(preset, AS_PRINTED)
    return {**drone, "sensors": _merge({"preset": name, **preset}, given)}


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _cross_faults(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Yield what no single field can know."""
    yield from _name_faults("drones", [drone.name for drone in scenario.drones])
    yield from _name_faults("clusters", [cluster.name for cluster in scenario.clusters])
    yield from _time_faults(scenario)
    yield from _start_faults(scenario)
    yield from _drone_faults(scenario)
    yield from _cluster_faults(scenario)
    window = scenario.report.window_s
    if window is not None and not 0 <= window[0] < window[1]:
        yield "report.window_s", f"is {list(window)}; must be [start, end] with 0 <= start < end"


def _name_faults(path: str, names: list[str]) -> Iterator[tuple[str, str]]:
    for index, name in enumerate(names):
        if name in names[:index]:
            yield f"{path}[{index}].name", f"is {name!r}, as {path}[{names.index(name)}]; must be unique"


def _time_faults(scenario: Scenario) -> Iterator[tuple[str, str]]:
    gate_us, dt_us = scenario.time.gate_ms * 1000, scenario.time.physics_dt_ms * 1000
    firmware_us = 5000  # the firmware's own step, 200 Hz
    if gate_us % firmware_us or gate_us % 1:
        yield "time.gate_ms", f"is {scenario.time.gate_ms:g}; must be a multiple of 5 (the firmware's step)"
    elif dt_us % 1 or firmware_us % dt_us:
        yield "time.physics_dt_ms", f"is {scenario.time.physics_dt_ms:g}; must divide 5 (the firmware's step)"


def _start_faults(scenario: Scenario) -> Iterator[tuple[str, str]]:
    positions = np.array([drone.position_m for drone in scenario.drones])
    for index, position in enumerate(positions):
        distances = np.linalg.norm(positions[:index] - position, axis=1)
        if position[2] < 0:
            yield f"drones[{index}].position_m[2]", f"is {position[2]:g}; must be >= 0 (the ground)"
        if len(distances) and distances.min() < START_SEPARATION_MIN_M:
            other = scenario.drones[int(distances.argmin())].name
            yield (
                f"drones[{index}].position_m",
                f"is {distances.min():.2f} m from {other!r}; must be >= {START_SEPARATION_MIN_M} m",
            )


def _drone_faults(scenario: Scenario) -> Iterator[tuple[str, str]]:
    for index, drone in enumerate(scenario.drones):
        if drone.rotor_min_rad_s >= drone.rotor_max_rad_s:
            yield (
                f"drones[{index}].rotor_min_rad_s",
                f"is {drone.rotor_min_rad_s:g}; must be < rotor_max_rad_s ({drone.rotor_max_rad_s:g})",
            )
        lift = 4 * drone.thrust_n_s2 * drone.rotor_max_rad_s**2 / scenario.environment.gravity_m_s2
        if drone.mass_kg >= 0.9 * lift:
            yield (
                f"drones[{index}].mass_kg",
                f"is {drone.mass_kg:g}; must be < {0.9 * lift:.3f}, nine tenths of what its rotors lift",
            )
        if drone.sensors.imu.rate_hz > 200:
            yield (
                f"drones[{index}].sensors.imu.rate_hz",
                f"is {drone.sensors.imu.rate_hz:g}; must be <= 200, the rate of the navigation board",
            )


def _cluster_faults(scenario: Scenario) -> Iterator[tuple[str, str]]:
    known = {drone.name for drone in scenario.drones}
    owner: dict[str, str] = {}
    for index, cluster in enumerate(scenario.clusters):
        for place, name in enumerate(cluster.drones):
            path = f"clusters[{index}].drones[{place}]"
            if name not in known:
                yield path, f"is {name!r}; must be one of the drones {', '.join(sorted(known))}"
            elif name in owner:
                yield path, f"is {name!r}, which {owner[name]!r} flies already; a drone is in one cluster"
            owner.setdefault(name, cluster.name)
        trajectory = cluster.plan.trajectory
        if trajectory and bool(trajectory.expressions) == bool(trajectory.waypoints):
            yield (
                f"clusters[{index}].plan.trajectory",
                "has both or neither of expressions and waypoints; must have one of them",
            )


def _whose(document: dict[str, Any], path: str) -> str:
    """Return " (drone 'drone3')" for a path inside a drone's entry."""
    match = re.match(r"drones\[(\d+)\]", path)
    drones = document.get("drones")
    if not match or not isinstance(drones, list):
        return ""
    entry = drones[int(match[1])]
    name = entry.get("name") if isinstance(entry, dict) else None
    return f" (drone {name!r})" if isinstance(name, str) else ""
