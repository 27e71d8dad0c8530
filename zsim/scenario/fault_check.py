"""What is wrong with a fault as somebody gives it: by the same tables in scenarios, requests and commands. Pure."""

from collections.abc import Iterator, Mapping
from difflib import SequenceMatcher
from typing import Any, NamedTuple

from zsim.contract import keys
from zsim.scenario.fault_kinds import KINDS, ROTOR, FaultKind, FaultParameter, expected
from zsim.scenario.role_table import AGENTS
from zsim.schema.checker import Fault as Flaw
from zsim.schema.checker import show

FOR_EVER_S = 1e6  # s, as the longest scenario
DEAF = ("world", "recorder", "console", "gateway", "router")  # roles that no gate waits for: none hears of a kill
ALIKE = 0.85  # of difflib, chosen: from here on, words as long as "controller" differ by a slip of the hand
COMMON = ("kind", "target", "at_s", "for_s")  # what every fault may say; the rest are parameters


class Known(NamedTuple):
    """Names that a target may have; `processes` are those that take part, beside estimators and controllers.

    `rotors` are those of each drone; none of one whose vehicle is a module that is not read here.
    """

    drones: tuple[str, ...]
    clusters: tuple[str, ...]
    processes: tuple[str, ...] = ()
    rotors: Mapping[str, tuple[str, ...]] = {}


def flaws(given: Any, known: Known) -> Iterator[Flaw]:
    """Yield the path and what is wrong of everything in a fault as it is given; nothing where it is sound."""
    if not isinstance(given, Mapping):
        yield "", f"is {show(given)}; must be a map with kind and target"
        return
    name = given.get("kind")
    kind = KINDS.get(name) if isinstance(name, str) else None
    if kind is None or not isinstance(name, str):
        yield "kind", f"{_found(given, 'kind')}; must be one of {', '.join(KINDS)}"
        return
    of = {parameter.name: parameter for parameter in kind.parameters}
    for field in given:
        if field not in COMMON and field not in of:
            allowed = ", ".join([*COMMON, *of])
            yield str(field)[:40], f"is not known; allowed: {allowed} ({name})"
    found = [*_target_flaws(given, name, kind, known), *_time_flaws(given, name, kind)]
    for parameter in kind.parameters:
        found += _parameter_flaws(given, _of_target(parameter, given.get("target"), known), known)
    for path, text in found:
        yield path, text if text.endswith(f"({name})") else f"{text} ({name})"


def _found(given: Mapping[str, Any], field: str) -> str:
    return f"is {show(given[field])}" if field in given else "is missing"


def _target_flaws(given: Mapping[str, Any], name: str, kind: FaultKind, known: Known) -> Iterator[Flaw]:
    found, target = _found(given, "target"), given.get("target")
    if kind.strikes == "link":
        yield from _link_flaws(found, target, given.get("one_way") is True, known)
    elif kind.strikes == "process":
        if not isinstance(target, str) or not _takes_part(target, known):
            yield "target", f"{found}; must be a process that takes part, as {_example(known)}"
        elif target.partition(".")[0] in DEAF:
            yield "target", f"{found}, outside of the lockstep; must be a process that takes part, as {_example(known)}"
    else:
        allowed = {"drone": known.drones, "world": ("world",), "radio": ("world", *known.clusters)}[kind.strikes]
        if target not in allowed:
            yield "target", f"{found}; must be {'one of ' if len(allowed) > 1 else ''}{_listed(allowed)}"


def _link_flaws(found: str, target: Any, one_way: bool, known: Known) -> Iterator[Flaw]:
    names = target.split("/") if isinstance(target, str) else []
    if len(names) != 2 or names[0] == names[1]:
        yield "target", f"{found}; must be two processes, as world/{_example(known)}"
        return
    for name in names:
        allowed = _allowed_instead(name, known)
        if allowed:
            yield "target", f"{found}; {name[:48]!r} must be {allowed}"
    heeds = f"the world or a process that takes part, as {_example(known)}"
    if not any(name == "world" or _takes_part(name, known) for name in names):
        yield "target", f"{found}; one of them must be {heeds}"
    elif one_way and names[1] != "world" and names[1].partition(".")[0] in DEAF:
        yield "target", f"{found}, one way, and {names[1]!r} is outside of the lockstep; the second must be {heeds}"


def _allowed_instead(name: str, known: Known) -> str | None:
    """Return what must stand in place of a process's name, None if it may stand: most names may be somebody's own."""
    if not keys.PROCESS_NAME.fullmatch(name):
        return "1 to 48 of a-z 0-9 _ . -"
    if name in known.processes:
        return None
    role, dot, thing = name.partition(".")
    things = _things(known)
    if role in things and thing not in things[role]:
        return f"{role}.NAME of {_listed(things[role])}"
    for ours, there in {**things, "world": ("",)}.items():
        if thing in there and ours not in role and SequenceMatcher(None, role, ours).ratio() >= ALIKE:
            return f"{ours}{dot}{thing}, or a name less like it"
    return None


def _things(known: Known) -> dict[str, tuple[str, ...]]:
    """Return what the processes of each role with agents may be named after."""
    return {name: known.drones if role.about == "drone" else known.clusters for name, role in AGENTS.items()}


def _takes_part(name: str, known: Known) -> bool:
    role, _, thing = name.partition(".")
    return thing in _things(known).get(role, ()) or name in known.processes


def _example(known: Known) -> str:
    return f"estimator.{known.drones[0]}" if known.drones else "estimator.drone1"


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names[:20]) + (f", … ({len(names)})" if len(names) > 20 else "")


def _time_flaws(given: Mapping[str, Any], name: str, kind: FaultKind) -> Iterator[Flaw]:
    at_s, for_s = given.get("at_s"), given.get("for_s")
    if at_s is not None and not _within(at_s, 0.0, FOR_EVER_S):
        yield "at_s", f"is {show(at_s)}; must be from 0 to {FOR_EVER_S:g} s"
    if kind.lasts == "once" and for_s is not None:
        yield "for_s", f"is {show(for_s)}; must be left out"
    elif kind.lasts == "ends" and for_s is None:
        yield "for_s", "is missing; must be its length in s"
    elif for_s is not None and not _within(for_s, 0.0, FOR_EVER_S, above=True):
        yield "for_s", f"is {show(for_s)}; must be > 0 and <= {FOR_EVER_S:g} s"


def _of_target(p: FaultParameter, target: Any, known: Known) -> FaultParameter:
    """Return a parameter as a target has it: its rotors are those of its vehicle, or have any name."""
    rotors = known.rotors.get(target) if p is ROTOR and isinstance(target, str) else None
    if rotors is None:
        return p
    return p._replace(choices=(*rotors, "all")) if rotors else p._replace(shape="word")


def _parameter_flaws(given: Mapping[str, Any], p: FaultParameter, known: Known) -> Iterator[Flaw]:
    value = given.get(p.name)
    if value is None:
        if p.required:
            yield p.name, f"is missing; must be {expected(p)}"
        return
    if p.shape == "vector":
        sound = isinstance(value, list | tuple) and len(value) == 3 and all(_within(x, p.least, p.most) for x in value)
    elif p.shape == "choice":
        sound = value in p.choices
    elif p.shape == "word":
        sound = isinstance(value, str)
    elif p.shape == "flag":
        sound = isinstance(value, bool)
    elif p.shape == "places":
        yield from _place_flaws(value, p, known)
        return
    else:
        sound = _within(value, p.least, p.most, p.above)
    if not sound:
        yield p.name, f"is {show(value)}; must be {expected(p)}"


def _place_flaws(value: Any, p: FaultParameter, known: Known) -> Iterator[Flaw]:
    if not isinstance(value, Mapping):
        yield p.name, f"is {show(value)}; must be {expected(p)}"
        return
    for process, place in value.items():
        allowed = _allowed_instead(process if isinstance(process, str) else "", known)
        if allowed:
            yield f"{p.name}.{str(process)[:48]}", f"names no process; must be {allowed}"
        point = isinstance(place, list | tuple) and len(place) == 3 and all(_within(x, -1e6, 1e6) for x in place)
        if not point and place not in known.drones:
            yield f"{p.name}.{str(process)[:48]}", f"is {show(place)}; must be a drone or [x, y, z] in m"


def _within(value: Any, least: float, most: float, above: bool = False) -> bool:
    """Tell whether a value is a number between limits; a comparison takes integers of any size, and no NaN."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and least <= value <= most and not (above and value == least)
