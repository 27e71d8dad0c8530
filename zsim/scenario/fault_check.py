"""What is wrong with the description of a fault: by the same tables in scenarios, requests and commands. Pure."""

from collections.abc import Iterator, Mapping, Sequence
from difflib import SequenceMatcher
from typing import Any, NamedTuple

from zsim.contract import keys
from zsim.scenario.fault_kinds import KINDS, ROTOR, FaultKind, FaultParameter, expected
from zsim.scenario.role_table import AGENTS
from zsim.schema.checker import Fault as Flaw
from zsim.schema.checker import show, suggestion

FOR_EVER_S = 1e6  # s, as the longest scenario
UNGATED = ("world", "recorder", "console", "gateway", "router")  # roles that no gate waits for: they ignore faults
ALIKE = 0.85  # of difflib, chosen: from here on, words as long as "controller" differ by a slip of the hand
COMMON = ("kind", "target", "at_s", "for_s")  # what every fault may have; the rest are parameters


class Known(NamedTuple):
    """Names that a target may have, and the kinds of faults of the run.

    `processes` are those that take part, beside estimators and controllers. `rotors` are those of each drone; none of
    one whose vehicle is a module that is not read here. `external` are those of the drones whose bodies and sensors
    nobody simulates.
    """

    drones: tuple[str, ...]
    clusters: tuple[str, ...]
    processes: tuple[str, ...] = ()
    kinds: Mapping[str, FaultKind] = KINDS
    rotors: Mapping[str, tuple[str, ...]] = {}
    external: tuple[str, ...] = ()


def flaws(fault: Any, known: Known) -> Iterator[Flaw]:
    """Yield path and text of every flaw of a fault as it stands in a scenario or request; nothing where it is sound."""
    if not isinstance(fault, Mapping):
        yield "", f"is {show(fault)}; must be a map with kind and target"
        return
    name = fault.get("kind")
    kind = known.kinds.get(name) if isinstance(name, str) else None
    if kind is None or not isinstance(name, str):
        yield "kind", f"{_actual(fault, 'kind')}; must be one of {', '.join(known.kinds)}"
        return
    of = {parameter.name: parameter for parameter in kind.parameters}
    for field in fault:
        if field not in COMMON and field not in of:
            allowed = ", ".join([*COMMON, *of])
            yield str(field)[:40], f"is not known; {suggestion(field, (*COMMON, *of))}allowed: {allowed} ({name})"
    faults = [*_target_flaws(fault, kind, known), *_time_flaws(fault, kind)]
    for parameter in kind.parameters:
        faults += _parameter_flaws(fault, _of_target(parameter, fault.get("target"), known), known)
    for path, text in faults:
        yield path, text if text.endswith(f"({name})") else f"{text} ({name})"


def _actual(fault: Mapping[str, Any], field: str) -> str:
    return f"is {show(fault[field])}" if field in fault else "is missing"


def _target_flaws(fault: Mapping[str, Any], kind: FaultKind, known: Known) -> Iterator[Flaw]:
    actual, target = _actual(fault, "target"), fault.get("target")
    if kind.strikes == "link":
        yield from _link_flaws(actual, target, fault.get("one_way") is True, known)
    elif kind.strikes == "process":
        if not isinstance(target, str) or not _takes_part(target, known):
            yield "target", f"{actual}; must be a process that takes part, as {_example(known)}"
        elif target.partition(".")[0] in UNGATED:
            yield (
                "target",
                f"{actual}, outside of the lockstep; must be a process that takes part, as {_example(known)}",
            )
    else:
        allowed = {"drone": known.drones, "world": ("world",), "radio": ("world", *known.clusters)}[kind.strikes]
        if target not in allowed:
            yield "target", f"{actual}; must be {'one of ' if len(allowed) > 1 else ''}{listed(allowed)}"
        elif kind.strikes == "drone" and target in known.external:
            yield "target", f"{actual}, whose body is external; must be a drone that is simulated"


def _link_flaws(actual: str, target: Any, one_way: bool, known: Known) -> Iterator[Flaw]:
    names = target.split("/") if isinstance(target, str) else []
    if len(names) != 2 or names[0] == names[1]:
        yield "target", f"{actual}; must be two processes, as world/{_example(known)}"
        return
    for name in names:
        allowed = _allowed_instead(name, known)
        if allowed:
            yield "target", f"{actual}; {name[:48]!r} must be {allowed}"
    receiver = f"the world or a process that takes part, as {_example(known)}"
    if not any(name == "world" or _takes_part(name, known) for name in names):
        yield "target", f"{actual}; one of them must be {receiver}"
    elif one_way and names[1] != "world" and names[1].partition(".")[0] in UNGATED:
        yield "target", f"{actual}, one way, and {names[1]!r} is outside of the lockstep; the second must be {receiver}"


def _allowed_instead(name: str, known: Known) -> str | None:
    """Return the text of what a process's name must be, None for a good one: most names may be of a user's process."""
    if not keys.PROCESS_NAME.fullmatch(name):
        return "1 to 48 of a-z 0-9 _ . -"
    if name in known.processes:
        return None
    role, dot, thing = name.partition(".")
    things = _things(known)
    if role in things and thing not in things[role]:
        return f"{role}.NAME of {listed(things[role])}"
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


def listed(names: Sequence[str]) -> str:
    """Return names for an error, the first 20 of them."""
    return ", ".join(names[:20]) + (f", … ({len(names)})" if len(names) > 20 else "")


def _time_flaws(fault: Mapping[str, Any], kind: FaultKind) -> Iterator[Flaw]:
    at_s, for_s = fault.get("at_s"), fault.get("for_s")
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


def _parameter_flaws(fault: Mapping[str, Any], p: FaultParameter, known: Known) -> Iterator[Flaw]:
    value = fault.get(p.name)
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
