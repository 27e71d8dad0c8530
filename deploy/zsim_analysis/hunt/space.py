"""The space that a hunt draws flights from, and the strategy by which it draws them.

The space consists of kinds of faults with their targets, times and magnitudes, fields of the scenario, and seeds. The
ranges follow from the declarations of the kinds (`zsim.scenario.faults`), whose limits are those of the simulation, far
beyond normal flight. If a limit is LARGE or more, magnitudes are drawn from SMALL_SHARE to LARGE_SHARE of it (GPS bias:
1 to 1000 m; link delay: 0.6 to 600 ms); if it is lower but above 1, from one hundredth of it to the limit (gust: 1 to
100 m/s); in both cases all decades are equally likely. Shares and probabilities are drawn uniformly. Rules narrow
ranges: `gust velocity_m_s=1..6 for_s=2..8`.

The strategy covers all small combinations of kinds, and exploits low margins. At least every second flight has a kind
that has not been tried; once all kinds have been, a pair that has not been tried together; then a triple (Kuhn, Wallace
and Gallo, IEEE Transactions on Software Engineering 30, 2004: few simultaneous conditions suffice to make software
fail). Most other flights, and most flights once all combinations have been tried, are neighbours of an elite, which is
the flight with the lowest margin for a set of kinds (MAP-Elites of Mouret and Clune, arXiv 1504.04909): numbers are
moved slightly, or a fault is replaced or taken from another elite. Draws depend on the seed, the number of the flight
and the margins of flights at least PENDING_MAX before it, but not on the number or speed of processes.
"""

import copy
import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.random import Generator

from zsim.errors import ScenarioError
from zsim.math.randomness import stream
from zsim.scenario import scenario_file
from zsim.scenario.faults import COMMON, FaultKind, FaultParameter, allowed_kinds, kinds_of
from zsim.scenario.roles import PILOT, WORLD, agent_names
from zsim.scenario.scenario import Scenario
from zsim.schema import yaml_file
from zsim.schema.checker import show
from zsim.sensors.sensor_catalogue import declarations, sensor_names
from zsim_agents.hosting import check_classes
from zsim_analysis.hunt.requirements import Margin
from zsim_analysis.sweep.design import SEED, SEEDS, Draw, Grid, Seeds, parse, text_of

OPTION = "--fault"
SYNTAX = "a kind and NAME=LOW..HIGH or NAME=VALUE, as in 'gust velocity_m_s=1..6 for_s=2..8'"
WIND = "environment.wind.gust_m_s=uniform(0, 2)"  # default of --vary; design choice
LARGE, SMALL_SHARE, LARGE_SHARE = 1000.0, 1e-5, 1e-2  # design choice; see the module docstring
FAULT_MIN_S = 0.5  # shortest duration of a fault; design choice: shorter ones would last only a few samples
DECADES = 30.0  # ratio of the ends of a range at or above which all decades are equally likely
ONE_WAY_SHARE = 1 / 3  # probability that a flag of a fault is set; design choice
DIGITS = 4  # significant digits of drawn numbers, so that their texts represent them exactly
_RANGE = re.compile(r"\s*([-+0-9.eE]+?)\.\.([-+0-9.eE]+)\s*")
PENDING_MAX = 32  # maximum number of pending flights; design choice: more than a machine's processes
TRIES = 24  # random sets of kinds, of which the one with the most untried combinations is flown
STEPS = (0.3, 0.1, 0.03)  # standard deviations of moves, as shares of a range; design choice
# probability of an untried combination in place of a neighbour, and of a random one if all are tried
EXPLORATION_PROBABILITY = 0.25


class Case(Struct, frozen=True):
    """The conditions of one flight."""

    seed: int
    values: dict[str, Any] = {}  # values of scenario fields by path
    faults: tuple[dict[str, Any], ...] = ()  # faults as in a scenario
    duration_s: float | None = None  # None: that of the scenario

    @property
    def kinds(self) -> tuple[str, ...]:
        """The distinct kinds of its faults, sorted."""
        return tuple(sorted({fault["kind"] for fault in self.faults}))


class Knob(Struct, frozen=True):
    """A parameter of a fault, with the range or the values from which it is drawn."""

    name: str
    low: float = 0.0  # limit of the number, or of the magnitude of a vector or signed number
    high: float = 0.0
    shape: str = "number"  # "number", "signed", "vector", or "choice"
    choices: tuple[Any, ...] = ()
    weights: tuple[float, ...] = ()  # probabilities of the choices; empty: equal

    @property
    def by_decades(self) -> bool:
        return self.low > 0 and self.high / self.low >= DECADES

    def draw(self, rng: Generator) -> Any:
        if self.shape == "choice":
            return self.choices[int(rng.choice(len(self.choices), p=self.weights or None))]
        return self._compose(self._magnitude(rng.uniform()), _direction(rng, self.shape))

    def near(self, value: Any, rng: Generator, step: float) -> Any:
        """Return a value moved by a normal draw with a standard deviation of `step` ranges; a choice is redrawn."""
        if self.shape == "choice" or value is None:
            return self.draw(rng)
        position = self.position(value) + step * rng.normal()
        position = abs(position) if position < 1 else 2 - position  # reflected at the ends
        size = float(np.linalg.norm(value))
        direction = np.asarray(value, float) / size if size > 0 else _direction(rng, self.shape)
        if self.shape == "vector":
            direction = direction + step * rng.normal(size=3)
            direction = direction / np.linalg.norm(direction)
        elif self.shape == "signed" and rng.uniform() < step:
            direction = -direction
        return self._compose(self._magnitude(float(np.clip(position, 0.0, 1.0))), direction)

    def position(self, value: Any) -> float:
        """Return the position of a value within its range, from 0 to 1."""
        size = float(np.linalg.norm(value)) if self.shape != "number" else float(value)
        if self.high <= self.low:
            return 0.0
        share = (
            math.log(max(size, self.low) / self.low) / math.log(self.high / self.low)
            if self.by_decades
            else (size - self.low) / (self.high - self.low)
        )
        return min(max(share, 0.0), 1.0)

    def _magnitude(self, share: float) -> float:
        if self.by_decades:
            return self.low * (self.high / self.low) ** share
        return self.low + share * (self.high - self.low)

    def _compose(self, size: float, direction: Any) -> Any:
        low, high = _rounded(self.low), _rounded(self.high)
        size = min(max(_rounded(size), low), high) if self.shape != "vector" else size
        if self.shape == "vector":
            return [_rounded(float(x)) for x in size * direction]
        return _rounded(float(size * direction)) if self.shape == "signed" else size


def _direction(rng: Generator, shape: str) -> Any:
    if shape == "vector":
        direction = rng.normal(size=3)
        return direction / np.linalg.norm(direction)
    return rng.choice([-1.0, 1.0]) if shape == "signed" else 1.0


def _rounded(x: float, digits: int = DIGITS) -> float:
    return float(f"{x:.{digits}g}")


class KindSpace(Struct, frozen=True):
    """The space of faults of one kind."""

    name: str
    kind: FaultKind
    knobs: dict[str, Knob]  # target, times and parameters by name

    def draw(self, rng: Generator) -> dict[str, Any]:
        return _clean({"kind": self.name, **{name: knob.draw(rng) for name, knob in self.knobs.items()}})

    def near(self, fault: Mapping[str, Any], rng: Generator, step: float) -> dict[str, Any]:
        """Return a fault with one or two values changed."""
        count = min(len(self.knobs), 1 + int(rng.integers(2)))
        moved = {str(each) for each in rng.choice(list(self.knobs), count, replace=False)}
        values = {
            name: knob.near(fault.get(name), rng, step) if name in moved else fault.get(name)
            for name, knob in self.knobs.items()
        }
        return _clean({"kind": self.name, **values})


def _clean(fault: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in fault.items() if value is not None and value is not False}


class HuntSpace:
    """The space of flights of a scenario.

    Args:
        document: raw document of the scenario.
        source: name of its file, for messages.
        rules: texts of `--fault`, each a kind with narrower ranges; empty: all kinds except deaths of processes.
        without: kinds that are not drawn.
        vary: texts of `--vary`; seeds are always drawn.
        faults_max: largest number of faults in one flight.

    Raises:
        ScenarioError: the arguments or the scenario are invalid; one line per fault.
    """

    def __init__(
        self,
        document: Mapping[str, Any],
        source: str,
        rules: Sequence[str] = (),
        without: Sequence[str] = (),
        vary: Sequence[str] = (WIND,),
        faults_max: int = 3,
    ) -> None:
        self.document, self.source = dict(document), source
        self.base = scenario_file.resolve(copy.deepcopy(self.document), source)
        check_classes(self.base, source)
        faults: list[str] = []
        self.fields = dict(self._fields(vary, faults))
        self.kinds = self._kinds(rules, without, faults)
        if faults:
            raise ScenarioError(faults)
        self._check_ends(rules)
        self.faults_max = min(faults_max, len(self.kinds))

    def scenario(self, case: Case) -> Scenario:
        """Return the resolved scenario of a flight; raise ScenarioError if it cannot be flown."""
        return scenario_file.resolve(self.changed(case), self.source)

    def changed(self, case: Case) -> dict[str, Any]:
        """Return the raw document of a flight."""
        document = copy.deepcopy(self.document)
        faults = []
        for path, value in case.values.items():
            parsed = lambda _, value=value: copy.deepcopy(value)  # noqa: E731 - argument of apply_override
            faults.append(scenario_file.apply_override(document, f"{path}={text_of(value)}", parsed))
        if lines := [f"--vary {fault.removeprefix('--set ')}" for fault in faults if fault]:
            raise ScenarioError(lines)
        document[SEED] = case.seed
        document["faults"] = [*(document.get("faults") or []), *copy.deepcopy(list(case.faults))]
        if case.duration_s is not None:
            document["duration_s"] = case.duration_s
        return document

    def options(self, case: Case) -> list[str]:
        """Return the differences between a flight and the scenario, as options of `zsim run`."""
        arguments = ["--seed", str(case.seed)]
        if case.duration_s is not None:
            arguments += ["--duration", f"{case.duration_s:g}"]
        for path, value in case.values.items():
            arguments += ["--set", f"{path}={text_of(value)}"]
        if case.faults:
            arguments += ["--set", f"faults={text_of([*(self.document.get('faults') or []), *case.faults])}"]
        return arguments

    # Draws

    def _fields(self, vary: Sequence[str], faults: list[str]) -> Iterator[tuple[str, Draw | Grid]]:
        for text in vary:
            try:
                axis = parse(text, self.document)
            except ValueError as error:
                faults.append(f"--vary {show(text)}: {error}")
                continue
            if isinstance(axis, Seeds):
                faults.append(f"--vary {show(text)}: seeds are drawn for every flight; must be left out")
            else:
                yield axis.path, axis

    def draw_value(self, path: str, rng: Generator) -> Any:
        axis = self.fields[path]
        if isinstance(axis, Grid):
            return axis.values[int(rng.integers(len(axis.values)))]
        value = rng.uniform(axis.first, axis.second) if axis.kind == "uniform" else rng.normal(axis.first, axis.second)
        return _rounded(float(value))

    def draw_seed(self, rng: Generator) -> int:
        return int(rng.integers(SEEDS))

    def targets_of(self, kind: FaultKind) -> tuple[str, ...]:
        """Return the possible targets of a kind of fault."""
        scenario = self.base
        if kind.strikes == "drone":
            simulated = [drone for drone in scenario.drones if not drone.is_external]
            suitable = [
                drone.name for drone in simulated if not kind.sensor or kind.sensor in sensor_names(drone.sensors)
            ]
            return tuple(suitable)
        if kind.strikes == "link":
            return tuple(links_of(scenario))
        if kind.strikes == "radio":
            return (WORLD, *(cluster.name for cluster in scenario.clusters))
        return (WORLD,) if kind.strikes == "world" else tuple(agent_names(scenario))

    def _kinds(self, rules: Sequence[str], without: Sequence[str], faults: list[str]) -> dict[str, KindSpace]:
        known = kinds_of(declarations(self.base.drones))
        narrowed: dict[str, dict[str, Any]] = {}
        for text in rules:
            try:
                kind, *tokens = shlex.split(text) or [""]
            except ValueError as error:
                faults.append(f"{OPTION} {show(text)}: {error}; must be {SYNTAX}")
                continue
            if kind not in known:
                faults.append(f"{OPTION} {show(text)}: {unknown_kind(kind, known)}")
                continue
            knobs = narrowed.setdefault(kind, {})
            for token in tokens:
                name, equals, value = token.partition("=")
                if not equals or name == "kind":
                    faults.append(f"{OPTION} {show(text)}: has {show(token)}; must be {SYNTAX}")
                    continue
                try:
                    knobs[name] = _given(name, value, known[kind])
                except ValueError as error:
                    faults.append(f"{OPTION} {show(text)}: {name} {error}")
        faults += [f"--without {show(each)}: {unknown_kind(each, known)}" for each in without if each not in known]
        names = narrowed or {name: {} for name, kind in known.items() if kind.strikes != "process"}
        kinds = {}
        for name, knobs in names.items():
            kind = known[name]
            has_target = "target" in knobs or self.targets_of(kind)
            if name in narrowed and not has_target:
                faults.append(f"{OPTION} {show(name)}: has no target in this scenario; must be a kind with one")
            if name not in without and has_target:
                kinds[name] = KindSpace(name, kind, self._knobs(kind) | knobs)
        return kinds

    def _knobs(self, kind: FaultKind) -> dict[str, Knob]:
        length_s = self.base.duration_s
        knobs = [Knob("target", shape="choice", choices=self.targets_of(kind))]
        knobs.append(Knob("at_s", 0.0, _rounded(length_s * (1 - 1e-3))))
        if kind.lasts != "once":
            knobs.append(Knob("for_s", min(FAULT_MIN_S, length_s / 2), length_s / 2))
        knobs += [knob for p in kind.parameters if (knob := _knob_of(p))]
        return {knob.name: knob for knob in knobs}

    def _check_ends(self, rules: Sequence[str]) -> None:
        """Raise ScenarioError if ends of ranges, means of normal distributions or listed values are invalid."""
        for path, axis in self.fields.items():
            limits = (axis.first, axis.second) if isinstance(axis, Draw) else axis.values
            for value in limits if isinstance(axis, Grid) or axis.kind == "uniform" else limits[:1]:
                try:
                    self.scenario(Case(self.base.seed, {path: value}))
                except ScenarioError as error:
                    raise ScenarioError([f"--vary {path}={text_of(value)}: {line}" for line in error.faults]) from error
        owners, ends = [], []
        for name, space in self.kinds.items():
            for end in (0, -1):
                fault: dict[str, Any] = {"kind": name}
                for knob in space.knobs.values():
                    size = (knob.low, knob.high)[end]
                    value = knob.choices[end] if knob.shape == "choice" else [size, 0.0, 0.0]
                    fault[knob.name] = value if knob.shape in ("choice", "vector") else size
                ends.append(_clean(fault))
                owners.append(name)
        for start in range(0, len(ends), 2):
            try:
                self.scenario(Case(self.base.seed, faults=tuple(ends[start : start + 2])))
            except ScenarioError as error:
                text = next((rule for rule in rules if rule.split()[:1] == [owners[start]]), owners[start])
                own_count = len(self.document.get("faults") or [])
                fault_prefix = re.compile(rf"^.*?faults\[(?:{own_count}|{own_count + 1})\]\.?")
                lines = dict.fromkeys(fault_prefix.sub("", fault) for fault in error.faults)
                raise ScenarioError([f"{OPTION} {show(text)}: {line}" for line in lines]) from error


def unknown_kind(kind: str, known: Mapping[str, FaultKind]) -> str:
    return f"{show(kind)} is not a kind of fault; {allowed_kinds(kind, known)}"


def _given(name: str, text: str, kind: FaultKind) -> Knob:
    """Parse the range or value that a rule gives for a parameter; raise ValueError if it cannot be read."""
    parameter = next((p for p in kind.parameters if p.name == name), None)
    if (ends := _RANGE.fullmatch(text)) is None:
        return Knob(name, shape="choice", choices=(yaml_file.value(text),))
    try:
        low, high = float(ends[1]), float(ends[2])
    except ValueError:
        raise ValueError(f"is {show(text)}; must be {SYNTAX}") from None
    if not (math.isfinite(high - low) and low <= high):
        raise ValueError(f"is {show(text)}; must be LOW..HIGH, finite numbers with LOW <= HIGH")
    is_number = name in COMMON[2:] or (parameter is not None and parameter.shape in ("number", "vector"))
    if parameter is not None and not is_number:
        raise ValueError(f"is {show(text)}; must be one value, not a range, of the type {parameter.shape}")
    if parameter is not None and parameter.shape == "vector":
        if low < 0:
            raise ValueError(f"is {show(text)}; must be a range of the magnitude with LOW >= 0, or [x, y, z]")
        return Knob(name, low, high, "vector")
    return Knob(name, low, high)


def _knob_of(p: FaultParameter) -> Knob | None:
    """Return the default range or values of a parameter; None if it is not drawn."""
    if p.shape == "choice":
        return Knob(p.name, shape="choice", choices=p.choices)
    if p.shape == "flag":
        return Knob(p.name, shape="choice", choices=(False, True), weights=(1 - ONE_WAY_SHARE, ONE_WAY_SHARE))
    if p.shape not in ("number", "vector") or not (p.required or p.default is not None):
        return None
    shape = "vector" if p.shape == "vector" else "signed" if p.least < 0 else "number"
    if p.most <= 1:
        return Knob(p.name, p.least, p.most, shape)
    low, high = (SMALL_SHARE, LARGE_SHARE) if p.most >= LARGE else (0.01, 1.0)
    return Knob(p.name, max(low * p.most, p.least), high * p.most, shape)


def links_of(scenario: Scenario) -> list[str]:
    """Return the links over which the agents of a scenario exchange messages, as targets of faults."""
    agents = agent_names(scenario)
    links = [f"{name}/{WORLD}" for name in agents]
    for cluster in scenario.clusters:
        links += [f"estimator.{drone}/controller.{cluster.name}" for drone in cluster.drones]
    links += [f"estimator.{drone}/{PILOT}.{drone}" for drone in scenario.piloted()]
    for role, own in scenario.own_agents.items():
        if own.per == "drone":
            links += [f"estimator.{drone.name}/{role}.{drone.name}" for drone in scenario.drones]
    return [link for link in links if set(link.split("/")) <= {*agents, WORLD}]


class Elite(NamedTuple):
    """The flight with the lowest margin for a set of kinds."""

    margin: Margin
    case: Case


class Coverage:
    """The combinations of kinds of faults that have been flown."""

    def __init__(self, kinds: Sequence[str], faults_max: int) -> None:
        self.kinds = sorted(kinds)
        self.possible = {size: list(combinations(self.kinds, size)) for size in range(1, min(faults_max, 3) + 1)}
        self.untried = {size: set(sets) for size, sets in self.possible.items()}
        self._order = {size: list(sets) for size, sets in self.possible.items()}

    def add(self, kinds: Sequence[str]) -> None:
        for size, untried in self.untried.items():
            untried.difference_update(combinations(kinds, size))

    def tried(self, size: int) -> int:
        return len(self.possible[size]) - len(self.untried[size])

    def next(self, rng: Generator, faults_max: int) -> tuple[str, ...] | None:
        """Return kinds for a flight, with untried combinations among them; None if all have been tried."""
        size = next((size for size in self.untried if self.untried[size]), None)
        if size is None:
            return None
        self._order[size] = order = [each for each in self._order[size] if each in self.untried[size]]
        best: tuple[int, tuple[str, ...]] = (-1, ())
        for _ in range(TRIES):
            chosen = list(order[int(rng.integers(len(order)))])
            others = [kind for kind in self.kinds if kind not in chosen]
            extra_count = min(faults_max - len(chosen), len(others))
            chosen = (
                sorted([*chosen, *(str(each) for each in rng.choice(others, extra_count, replace=False))])
                if extra_count
                else chosen
            )
            count = sum(each in self.untried[size] for each in combinations(chosen, size))
            best = max(best, (count, tuple(chosen)))
        return best[1]


class Strategy:
    """Draws the flights of a hunt; `learn` must be called for them in the order drawn."""

    def __init__(self, space: HuntSpace, seed: int) -> None:
        self.space, self.seed = space, seed
        self._planned = Coverage(list(space.kinds), space.faults_max)
        self.coverage = Coverage(list(space.kinds), space.faults_max)  # combinations in finished flights
        self.elites: dict[tuple[str, ...], Elite] = {}
        self._drawn_count = 0

    def draw(self) -> Case:
        """Return the next flight; the first one has no faults."""
        rng = stream(self.seed, f"hunt/{self._drawn_count}")
        explores = self._drawn_count % 2 == 1 or not self.elites
        is_first, self._drawn_count = self._drawn_count == 0, self._drawn_count + 1
        if is_first:
            return Case(self.space.base.seed)
        if explores or rng.uniform() < EXPLORATION_PROBABILITY:
            kinds = self._planned.next(rng, self.space.faults_max)
            if kinds is None and (rng.uniform() < EXPLORATION_PROBABILITY or not self.elites):
                names = list(self.space.kinds)
                kinds = (
                    tuple(str(each) for each in rng.choice(names, self.space.faults_max, replace=False))
                    if names
                    else ()
                )
            if kinds is not None:
                self._planned.add(tuple(sorted(kinds)))
                faults = tuple(self.space.kinds[kind].draw(rng) for kind in kinds)
                values = {path: self.space.draw_value(path, rng) for path in self.space.fields}
                return Case(self.space.draw_seed(rng), values, faults)
        case = self._near(rng)
        self._planned.add(case.kinds)
        return case

    def learn(self, case: Case, margin: Margin) -> None:
        """Record the margin of a flight."""
        self.coverage.add(case.kinds)
        best = self.elites.get(case.kinds)
        if case.faults and (best is None or (margin.share < best.margin.share)):
            self.elites[case.kinds] = Elite(margin, case)

    def _near(self, rng: Generator) -> Case:
        """Return a neighbour of an elite, preferring elites with low margins."""
        ranked = sorted(self.elites.values(), key=lambda elite: (elite.margin.share, elite.case.kinds))
        parent = self._pick(ranked, rng)
        faults, kinds = list(parent.faults), self.space.kinds
        index, move = int(rng.integers(len(faults))), rng.uniform()
        if move < 0.25 and len(ranked) > 1:  # add a fault of another elite, replacing one if there are too many
            other = self._pick(ranked, rng)
            fault = other.faults[int(rng.integers(len(other.faults)))]
            faults = faults if len(faults) < self.space.faults_max else [*faults[:index], *faults[index + 1 :]]
            faults = [*(each for each in faults if each["kind"] != fault["kind"]), fault]
        elif move < 0.4:
            names = sorted(set(kinds) - set(parent.kinds)) or list(kinds)
            faults[index] = kinds[str(rng.choice(names))].draw(rng)
        else:
            step = float(rng.choice(STEPS))
            faults[index] = kinds[faults[index]["kind"]].near(faults[index], rng, step)
        values = {
            path: self.space.draw_value(path, rng) if rng.uniform() < 0.2 else value
            for path, value in parent.values.items()
        }
        seed = parent.seed if rng.uniform() < 0.5 else self.space.draw_seed(rng)
        return Case(seed, values, tuple(faults))

    @staticmethod
    def _pick(ranked: list[Elite], rng: Generator) -> Case:
        return ranked[int(len(ranked) * rng.uniform() ** 3)].case
