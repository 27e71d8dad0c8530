"""Shrinks a flight that violates a requirement: fewest causes, then smallest values, then the shortest flight.

Causes are faults and fields that differ from the scenario. Sets of causes are flown in order of size, so that the
result is minimal; if there are more than SUBSETS_MAX causes, single ones are removed first (delta debugging of Zeller
and Hildebrandt, IEEE Transactions on Software Engineering 28, 2002, at its finest granularity). Every number is then
bisected between its value and one without effect. The candidates of a step are flown in parallel, and the first one in
order that violates the requirement is taken, so the result does not depend on which of them finishes first.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from zsim.scenario.scenario_file import steps_of
from zsim_analysis.hunt.space import Case, HuntSpace

SUBSETS_MAX = 6  # most causes of which all proper subsets are flown: at most 63 flights
ROUNDS = 3  # rounds of a bisection, each of which reduces the interval to a quarter
PASSES = 2  # passes over all numbers, since a smaller number may allow another to become smaller
SHARES = (0.25, 0.5, 0.75)  # candidates of a round, as shares of the interval
RATIO = 30.0  # ratio of two numbers from which on they are interpolated logarithmically
SHORTEST_S = 1.0  # shortest duration of a flight; design choice
CAUSES, NUMBERS, DURATION = "fewest causes", "smallest values", "shortest flight"  # stages

Breaks = Callable[[Sequence[Case], str], list[bool]]
"""Flies cases in a stage; returns whether each violates the requirement, False if it cannot be flown."""

Cause = tuple[str, int | str]  # ("fault", index) or ("value", path)


class Shrinker:
    """Shrinks a case that violates a requirement; `breaks` flies candidates."""

    def __init__(self, space: HuntSpace, breaks: Breaks) -> None:
        self._space, self._breaks = space, breaks

    def shrink(self, case: Case) -> Iterator[Case]:
        """Yield the case after each stage."""
        case = self.fewest(case)
        yield case
        case = self.smallest(case)
        yield case
        yield self.shortest(case)

    # Causes

    def fewest(self, case: Case) -> Case:
        """Return the case reduced to the fewest causes that still violate the requirement."""
        causes = causes_of(case)
        while len(causes) > SUBSETS_MAX:
            without = [[*causes[:place], *causes[place + 1 :]] for place in range(len(causes))]
            broken = self._breaks([only(case, each) for each in without], CAUSES)
            if not any(broken):
                break
            causes = without[broken.index(True)]
        for size in range(len(causes) if len(causes) <= SUBSETS_MAX else 0):
            sets = [list(each) for each in combinations(causes, size)]
            broken = self._breaks([only(case, each) for each in sets], CAUSES)
            if any(broken):
                causes = sets[broken.index(True)]
                break
        return only(case, causes)

    # Numbers

    def smallest(self, case: Case) -> Case:
        """Return the case with every number as mild as possible while still violating the requirement."""
        for _ in range(PASSES):
            before = case
            for place in range(len(case.faults)):
                case = self._smallest_fault(case, place)
            for path, value in case.values.items():
                own = self._space_value(path)
                if _is_number(value) and _is_number(own):
                    case = self._bisected(
                        lambda x, path=path, case=case: replace(case, values={**case.values, path: x}), value, own, case
                    )
            if case == before:
                break
        return case

    def _smallest_fault(self, case: Case, place: int) -> Case:
        space = self._space.kinds[case.faults[place]["kind"]]
        mildest = {p.name: p.mildest for p in space.kind.parameters if p.shape in ("number", "vector")}
        for name in ["for_s", *mildest]:
            value = case.faults[place].get(name)
            if isinstance(value, list):
                case = self._fewest_axes(case, place, name)
                vector = np.array(case.faults[place][name], float)
                size = float(np.linalg.norm(vector))
                if size > 0:
                    case = self._bisected(lambda x: _set(case, place, name, _scaled(vector, x / size)), size, 0.0, case)  # noqa: B023
            elif isinstance(value, int | float) and _is_number(value):
                case = self._bisected(
                    lambda x, case=case, name=name: _set(case, place, name, x), value, mildest.get(name, 0.0), case
                )
        return case

    def _fewest_axes(self, case: Case, place: int, name: str) -> Case:
        """Return the case with as many components of a vector at 0 as possible, starting with the smallest."""
        while True:
            vector = case.faults[place][name]
            axes = sorted((abs(x), axis) for axis, x in enumerate(vector) if x)
            tried = [
                _set(case, place, name, [0.0 if i == axis else x for i, x in enumerate(vector)]) for _, axis in axes
            ]
            broken = self._breaks(tried, NUMBERS) if len(tried) > 1 else []
            if not any(broken):
                return case
            case = tried[broken.index(True)]

    def _bisected(self, case_of: Callable[[float], Case], value: float, mildest: float, case: Case) -> Case:
        """Return the case with the number closest to `mildest` that still violates, with few digits if possible."""
        low, high = 0.0, 1.0  # interval between the mildest number (0) and the one that violates (1)
        for _ in range(ROUNDS):
            shares = [low + share * (high - low) for share in SHARES]
            broken = self._breaks([case_of(_between(mildest, value, share)) for share in shares], NUMBERS)
            first = broken.index(True) if any(broken) else len(shares)
            low, high = [low, *shares][first], [*shares, high][first]
        found = case_of(_between(mildest, value, high)) if high < 1.0 else case
        number = _between(mildest, value, high)
        short = [case_of(each) for digits in (1, 2) if (each := _outward(number, mildest, value, digits)) is not None]
        broken = self._breaks(short, NUMBERS) if short else []
        return short[broken.index(True)] if any(broken) else found

    def _space_value(self, path: str) -> Any:
        """Return the scenario's value of a field; None if it has none."""
        value: Any = msgspec.to_builtins(self._space.base)
        for step in steps_of(path, self._space.document):
            if isinstance(value, list):
                named = [each for each in value if isinstance(each, Mapping) and each.get("name") == step]
                value = named[0] if named else value[int(step)] if step.isdigit() and int(step) < len(value) else None
            else:
                value = value.get(step) if isinstance(value, Mapping) else None
        return value

    # Duration

    def shortest(self, case: Case) -> Case:
        """Return the case with the shortest flight that violates the requirement, but would not without its causes."""
        if not case.faults:
            return case
        length = case.duration_s or self._space.base.duration_s
        begun = max((fault.get("at_s", 0.0) for fault in case.faults), default=0.0)
        least = max(begun, SHORTEST_S)
        case = self._shorter(lambda x: replace(case, duration_s=x), least, length, case)
        first = min(fault.get("at_s", 0.0) for fault in case.faults)
        length = case.duration_s or length
        late = case

        def earlier(by_s: float) -> Case:  # the same case, with all faults earlier
            faults = tuple({**each, "at_s": _round(each["at_s"] - by_s)} for each in late.faults)
            return replace(late, faults=faults, duration_s=_round(length - by_s))

        if first > 0 and all("at_s" in each for each in late.faults):
            case = self._shorter(lambda x: earlier(length - x), max(length - first, SHORTEST_S), length, case)
        return case

    def _shorter(self, case_of: Callable[[float], Case], least: float, most: float, case: Case) -> Case:
        for _ in range(ROUNDS):
            lengths = [_round(least + share * (most - least)) for share in SHARES]
            tried = [case_of(each) for each in lengths]
            broken = self._breaks(tried, DURATION)
            good = (place for place, each in enumerate(tried) if broken[place] and self._holds_idle(each))
            first = next(good, len(tried))
            case = tried[first] if first < len(tried) else case
            least, most = [least, *lengths][first], [*lengths, most][first]
        return case

    def _holds_idle(self, case: Case) -> bool:
        return not any(self._breaks([replace(case, faults=(), values={})], DURATION))


def causes_of(case: Case) -> list[Cause]:
    return [*(("fault", place) for place in range(len(case.faults))), *(("value", path) for path in case.values)]


def only(case: Case, causes: Sequence[Cause]) -> Case:
    """Return a case reduced to the given causes."""
    faults = tuple(fault for place, fault in enumerate(case.faults) if ("fault", place) in causes)
    return replace(case, faults=faults, values={p: v for p, v in case.values.items() if ("value", p) in causes})


def _set(case: Case, place: int, name: str, value: Any) -> Case:
    faults = list(case.faults)
    faults[place] = {**faults[place], name: value}
    return replace(case, faults=tuple(faults))


def _between(mildest: float, value: float, share: float) -> float:
    if mildest > 0 and value > 0 and max(mildest / value, value / mildest) >= RATIO:
        return _round(mildest * (value / mildest) ** share)
    return _round(mildest + share * (value - mildest))


def _scaled(vector: Any, factor: float) -> list[float]:
    return [_round(float(x)) for x in vector * factor]


def _round(x: float, digits: int = 4) -> float:
    return float(f"{x:.{digits}g}")


def _outward(number: float, mildest: float, value: float, digits: int) -> float | None:
    """Round a number to few digits, away from the mildest; return None if that exceeds the original value."""
    if number == 0:
        return None
    unit = 10.0 ** (math.floor(math.log10(abs(number))) - digits + 1)
    steps = number / unit
    rounded = math.ceil(steps - 1e-9) if value > mildest else math.floor(steps + 1e-9)
    found = _round(rounded * unit, digits + 1)
    return found if min(mildest, value) <= found <= max(mildest, value) and found != number else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
