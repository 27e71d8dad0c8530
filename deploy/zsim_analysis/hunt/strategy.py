"""How the flights of a hunt are drawn: so that all few kinds of faults are tried together, and where margins are low.

Every second flight has kinds of which a pair, or else a triple, has not been tried together (Kuhn, Wallace and Gallo,
IEEE Transactions on Software Engineering 30, 2004: failures of software need few conditions at once). The others are
neighbours of the flights with the lowest margins, the best one of each set of kinds being kept (MAP-Elites of Mouret
and Clune, arXiv 1504.04909): numbers moved a little, a fault replaced, or one taken over from another of the best. Both
are drawn from the seed, the number of the flight and the margins of flights LAG and more before it, so that neither the
number of processes nor their speed has an effect.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

from numpy.random import Generator

from zsim.math.random_streams import stream
from zsim_analysis.hunt.requirements import Margin
from zsim_analysis.hunt.space import Case, HuntSpace

LAG = 32  # flights under way at most, chosen: more processes than a machine has
TRIES = 24  # sets of kinds of which the one with the most untried combinations is flown
STEPS = (0.3, 0.1, 0.03)  # of the ranges, chosen
AGAIN = 0.25  # share of flights drawn anew once all combinations have been tried


class Elite(NamedTuple):
    """The flight with the lowest margin of a set of kinds."""

    margin: Margin
    case: Case


class Coverage:
    """Which kinds of faults have been flown together."""

    def __init__(self, kinds: Sequence[str], most: int) -> None:
        self.kinds = sorted(kinds)
        self.possible = {size: list(combinations(self.kinds, size)) for size in range(1, min(most, 3) + 1)}
        self.untried = {size: set(sets) for size, sets in self.possible.items()}
        self._order = {size: list(sets) for size, sets in self.possible.items()}

    def add(self, kinds: Sequence[str]) -> None:
        for size, untried in self.untried.items():
            untried.difference_update(combinations(kinds, size))

    def tried(self, size: int) -> int:
        return len(self.possible[size]) - len(self.untried[size])

    def next(self, rng: Generator, most: int) -> tuple[str, ...] | None:
        """Return kinds for a flight, with untried combinations; None if there are none."""
        size = next((size for size in self.untried if self.untried[size]), None)
        if size is None:
            return None
        self._order[size] = order = [each for each in self._order[size] if each in self.untried[size]]
        best: tuple[int, tuple[str, ...]] = (-1, ())
        for _ in range(TRIES):
            chosen = list(order[int(rng.integers(len(order)))])
            others = [kind for kind in self.kinds if kind not in chosen]
            more = min(most - len(chosen), len(others))
            chosen = (
                sorted([*chosen, *(str(each) for each in rng.choice(others, more, replace=False))]) if more else chosen
            )
            count = sum(each in self.untried[size] for each in combinations(chosen, size))
            best = max(best, (count, tuple(chosen)))
        return best[1]


class Strategy:
    """Draws the flights of a hunt, in order; `learn` has to follow in the same order."""

    def __init__(self, space: HuntSpace, seed: int) -> None:
        self.space, self.seed = space, seed
        self._planned = Coverage(list(space.kinds), space.most)
        self.coverage = Coverage(list(space.kinds), space.most)  # of the flights that were flown
        self.elites: dict[tuple[str, ...], Elite] = {}
        self._drawn = 0

    def draw(self) -> Case:
        """Return the next flight; the first one has no fault."""
        rng = stream(self.seed, f"hunt/{self._drawn}")
        explores = self._drawn % 2 == 1 or not self.elites
        first, self._drawn = self._drawn == 0, self._drawn + 1
        if first:
            return Case(self.space.base.seed)
        if explores or rng.uniform() < AGAIN:
            kinds = self._planned.next(rng, self.space.most)
            if kinds is None and (rng.uniform() < AGAIN or not self.elites):
                names = list(self.space.kinds)
                kinds = tuple(str(each) for each in rng.choice(names, self.space.most, replace=False)) if names else ()
            if kinds is not None:
                self._planned.add(tuple(sorted(kinds)))
                return self._anew(kinds, rng)
        case = self._near(rng)
        self._planned.add(case.kinds)
        return case

    def learn(self, case: Case, margin: Margin) -> None:
        """Take note of the margin of a flight."""
        self.coverage.add(case.kinds)
        known = self.elites.get(case.kinds)
        if case.faults and (known is None or (margin.share < known.margin.share)):
            self.elites[case.kinds] = Elite(margin, case)

    def _anew(self, kinds: Sequence[str], rng: Generator) -> Case:
        faults = tuple(self.space.kinds[kind].draw(rng) for kind in kinds)
        values = {path: self.space.draw_value(path, rng) for path in self.space.fields}
        return Case(self.space.draw_seed(rng), values, faults)

    def _near(self, rng: Generator) -> Case:
        """Return a neighbour of one of the best flights, the better ones more often."""
        ranked = sorted(self.elites.values(), key=lambda elite: (elite.margin.share, elite.case.kinds))
        parent = self._pick(ranked, rng)
        faults, kinds = list(parent.faults), self.space.kinds
        place, how = int(rng.integers(len(faults))), rng.uniform()
        if how < 0.25 and len(ranked) > 1:  # a fault of another of the best, instead of one or beside them
            other = self._pick(ranked, rng)
            fault = other.faults[int(rng.integers(len(other.faults)))]
            faults = faults if len(faults) < self.space.most else [*faults[:place], *faults[place + 1 :]]
            faults = [*(each for each in faults if each["kind"] != fault["kind"]), fault]
        elif how < 0.4:
            names = sorted(set(kinds) - set(parent.kinds)) or list(kinds)
            faults[place] = kinds[str(rng.choice(names))].draw(rng)
        else:
            step = float(rng.choice(STEPS))
            faults[place] = kinds[faults[place]["kind"]].near(faults[place], rng, step)
        values = {
            path: self.space.draw_value(path, rng) if rng.uniform() < 0.2 else value
            for path, value in parent.values.items()
        }
        seed = parent.seed if rng.uniform() < 0.5 else self.space.draw_seed(rng)
        return Case(seed, values, tuple(faults))

    @staticmethod
    def _pick(ranked: list[Elite], rng: Generator) -> Case:
        return ranked[int(len(ranked) * rng.uniform() ** 3)].case
