"""Shrinks a flight that violates a requirement: fewest causes, then smallest values, then the shortest flight.

Causes are faults and fields that differ from the scenario. Sets of causes are flown in order of size, so that the
result is minimal; if there are more than SUBSETS_MAX causes, they are first removed one at a time (delta debugging of
Zeller and Hildebrandt, IEEE Transactions on Software Engineering 28, 2002, at its finest granularity). Each number is
then bisected between its value and one without effect. The candidates of a step are flown in parallel, and the first
one in order that violates the requirement is taken, so the result does not depend on which of them finishes first.
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

SUBSETS_MAX = 6  # maximum number of causes of which all proper subsets are flown: at most 63 flights
ROUNDS = 3  # rounds of a bisection, each of which reduces the interval to a quarter
PASSES = 2  # passes over all numbers, since a smaller number may allow another to become smaller
SHARES = (0.25, 0.5, 0.75)  # candidates of a round, as shares of the interval
RATIO = 30.0  # ratio of two numbers at or above which they are interpolated logarithmically
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
        case = self.fewest_causes(case)
        yield case
        case = self.smallest_values(case)
        yield case
        yield self.shortest_flight(case)

    # Causes

    def fewest_causes(self, case: Case) -> Case:
        """Return the case reduced to the fewest causes that still violate the requirement."""
        causes = causes_of(case)
        while len(causes) > SUBSETS_MAX:
            reduced = [[*causes[:index], *causes[index + 1 :]] for index in range(len(causes))]
            violates = self._breaks([reduced_to(case, each) for each in reduced], CAUSES)
            if not any(violates):
                break
            causes = reduced[violates.index(True)]
        for size in range(len(causes) if len(causes) <= SUBSETS_MAX else 0):
            subsets = [list(each) for each in combinations(causes, size)]
            violates = self._breaks([reduced_to(case, each) for each in subsets], CAUSES)
            if any(violates):
                causes = subsets[violates.index(True)]
                break
        return reduced_to(case, causes)

    # Numbers

    def smallest_values(self, case: Case) -> Case:
        """Return the case with every number as mild as possible while still violating the requirement."""
        for _ in range(PASSES):
            previous = case
            for index in range(len(case.faults)):
                case = self._smallest_fault(case, index)
            for path, value in case.values.items():
                base_value = self._space_value(path)
                if _is_number(value) and _is_number(base_value):
                    case = self._bisect(
                        lambda x, path=path, case=case: replace(case, values={**case.values, path: x}),
                        value,
                        base_value,
                        case,
                    )
            if case == previous:
                break
        return case

    def _smallest_fault(self, case: Case, index: int) -> Case:
        space = self._space.kinds[case.faults[index]["kind"]]
        mildest = {p.name: p.mildest for p in space.kind.parameters if p.shape in ("number", "vector")}
        for name in ["for_s", *mildest]:
            value = case.faults[index].get(name)
            if isinstance(value, list):
                case = self._fewest_axes(case, index, name)
                vector = np.array(case.faults[index][name], float)
                size = float(np.linalg.norm(vector))
                if size > 0:
                    case = self._bisect(lambda x: _set(case, index, name, _scaled(vector, x / size)), size, 0.0, case)  # noqa: B023
            elif isinstance(value, int | float) and _is_number(value):
                case = self._bisect(
                    lambda x, case=case, name=name: _set(case, index, name, x), value, mildest.get(name, 0.0), case
                )
        return case

    def _fewest_axes(self, case: Case, index: int, name: str) -> Case:
        """Return the case with as many components of a vector at 0 as possible, starting with the smallest."""
        while True:
            vector = case.faults[index][name]
            axes = sorted((abs(x), axis) for axis, x in enumerate(vector) if x)
            candidates = [
                _set(case, index, name, [0.0 if i == axis else x for i, x in enumerate(vector)]) for _, axis in axes
            ]
            violates = self._breaks(candidates, NUMBERS) if len(candidates) > 1 else []
            if not any(violates):
                return case
            case = candidates[violates.index(True)]

    def _bisect(self, case_of: Callable[[float], Case], value: float, mildest: float, case: Case) -> Case:
        """Return the case with the number closest to `mildest` that violates the requirement, rounded if possible."""
        low, high = 0.0, 1.0  # interval between the mildest number (0) and the one that violates the requirement (1)
        for _ in range(ROUNDS):
            shares = [low + share * (high - low) for share in SHARES]
            violates = self._breaks([case_of(_between(mildest, value, share)) for share in shares], NUMBERS)
            first = violates.index(True) if any(violates) else len(shares)
            low, high = [low, *shares][first], [*shares, high][first]
        result = case_of(_between(mildest, value, high)) if high < 1.0 else case
        number = _between(mildest, value, high)
        rounded = [case_of(each) for digits in (1, 2) if (each := _outward(number, mildest, value, digits)) is not None]
        violates = self._breaks(rounded, NUMBERS) if rounded else []
        return rounded[violates.index(True)] if any(violates) else result

    def _space_value(self, path: str) -> Any:
        """Return the scenario's value of a field; None if it has none."""
        value: Any = msgspec.to_builtins(self._space.base)
        for step in steps_of(path, self._space.document):
            if isinstance(value, list):
                matching = [each for each in value if isinstance(each, Mapping) and each.get("name") == step]
                value = (
                    matching[0] if matching else value[int(step)] if step.isdigit() and int(step) < len(value) else None
                )
            else:
                value = value.get(step) if isinstance(value, Mapping) else None
        return value

    # Duration

    def shortest_flight(self, case: Case) -> Case:
        """Return the case with the shortest flight that violates the requirement, but would not without its causes.

        A case without faults is returned unchanged.
        """
        if not case.faults:
            return case
        length_s = case.duration_s or self._space.base.duration_s
        last_fault_s = max((fault.get("at_s", 0.0) for fault in case.faults), default=0.0)
        shortest_s = max(last_fault_s, SHORTEST_S)
        case = self._shorten(lambda x: replace(case, duration_s=x), shortest_s, length_s, case)
        first_fault_s = min(fault.get("at_s", 0.0) for fault in case.faults)
        length_s = case.duration_s or length_s
        unshifted = case

        def earlier(by_s: float) -> Case:  # the same case, with all faults earlier
            faults = tuple({**each, "at_s": _round(each["at_s"] - by_s)} for each in unshifted.faults)
            return replace(unshifted, faults=faults, duration_s=_round(length_s - by_s))

        if first_fault_s > 0 and all("at_s" in each for each in unshifted.faults):
            case = self._shorten(
                lambda x: earlier(length_s - x), max(length_s - first_fault_s, SHORTEST_S), length_s, case
            )
        return case

    def _shorten(self, case_of: Callable[[float], Case], low_s: float, high_s: float, case: Case) -> Case:
        for _ in range(ROUNDS):
            lengths_s = [_round(low_s + share * (high_s - low_s)) for share in SHARES]
            candidates = [case_of(each) for each in lengths_s]
            violates = self._breaks(candidates, DURATION)
            acceptable = (index for index, each in enumerate(candidates) if violates[index] and self._holds_idle(each))
            first = next(acceptable, len(candidates))
            case = candidates[first] if first < len(candidates) else case
            low_s, high_s = [low_s, *lengths_s][first], [*lengths_s, high_s][first]
        return case

    def _holds_idle(self, case: Case) -> bool:
        return not any(self._breaks([replace(case, faults=(), values={})], DURATION))


def causes_of(case: Case) -> list[Cause]:
    return [*(("fault", index) for index in range(len(case.faults))), *(("value", path) for path in case.values)]


def reduced_to(case: Case, causes: Sequence[Cause]) -> Case:
    """Return a case reduced to the given causes."""
    faults = tuple(fault for index, fault in enumerate(case.faults) if ("fault", index) in causes)
    return replace(case, faults=faults, values={p: v for p, v in case.values.items() if ("value", p) in causes})


def _set(case: Case, index: int, name: str, value: Any) -> Case:
    faults = list(case.faults)
    faults[index] = {**faults[index], name: value}
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
    """Round a number to significant digits, away from the mildest; None if that passes `value` or changes nothing."""
    if number == 0:
        return None
    unit = 10.0 ** (math.floor(math.log10(abs(number))) - digits + 1)
    steps = number / unit
    rounded = math.ceil(steps - 1e-9) if value > mildest else math.floor(steps + 1e-9)
    result = _round(rounded * unit, digits + 1)
    return result if min(mildest, value) <= result <= max(mildest, value) and result != number else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
