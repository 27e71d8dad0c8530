"""Assertions about a run, for tests: bounds on its errors, no collisions, and bit-identity with another run."""

from abc import ABC, abstractmethod
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from zsim.contract import keys
from zsim.contract.run_messages import Event
from zsim.errors import RunError
from zsim.record import RecordReader
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.recorded_run import decode_or_none, gates
from zsim_analysis.rerun import TruthComparison

if TYPE_CHECKING:
    from zsim_api.recorded import Run

NAMED_MAX = 3  # maximum number of collisions listed in a failure


class Assertions(ABC):
    """Assertions about a run; each of them first lets the run finish."""

    @abstractmethod
    def run(self) -> "Run":
        """Return the recorded run."""

    def assert_errors(
        self, window: tuple[float, float] | None = None, cluster: str | None = None, **rms: float
    ) -> None:
        """Assert bounds on the true errors of a formation: the RMS of truth − desired while it is engaged.

        Args:
            window: start and end [s]; None: that of the report.
            cluster: name; None: the first.
            rms: largest allowed RMS of each cluster variable [m, rad], such as p=0.3.

        Raises:
            AssertionError: an RMS exceeds its bound (one line for each, with the largest error and its time) or is
                unknown, the run ended before the window did, or the formation was not engaged throughout the window.
            RunError: the formation has no such variable.
        """
        __tracebackhide__ = True  # pytest then shows the line of the test, not this function
        run = self.run()
        formation = run.judged_formation(cluster)
        window = window or run.summary.window_s
        where = f"{formation.name} from {window[0]:g} to {window[1]:g} s"
        if unknown := [name for name in rms if name not in formation.names]:
            raise RunError(
                f"{formation.name} has no variable {unknown[0]!r}; must be one of {', '.join(formation.names)}"
            )
        share, errors_by_name, faults = formation.engaged_share(window), formation.errors(window), []
        if window[1] > run.duration_s:
            faults.append(f"{where}: the run ended at {run.duration_s:g} s")
        elif share != 1.0:
            faults.append(f"{where}: the formation was engaged for {share or 0:.0%} of the time; must be all of it")
        for name, allowed in rms.items():
            error = errors_by_name[name].true_rms
            if error is None:
                faults.append(f"{where}: true RMS of {name} is unknown")
            elif not error <= allowed:
                errors = np.where(
                    formation.judged(window), np.abs(formation.true_error[:, formation.column(name)]), 0.0
                )
                row = int(np.nanargmax(errors))
                largest = f"the largest error is {errors[row]:.3g}, at {formation.t_s[row]:.2f} s"
                faults.append(
                    f"{where}: true RMS of {name} is {error:.3g} {unit(name)}; must be at most {allowed:g}; {largest}"
                )
        if faults:
            raise AssertionError("\n".join([*faults, f"the record is {run.record}"]))

    def assert_no_collision(self) -> None:
        """Assert that no drone collided with another drone or an obstacle; the AssertionError says which, and when."""
        __tracebackhide__ = True
        run = self.run()
        with RecordReader(run.record) as reader:
            events = [decode_or_none(recorded) for recorded in reader.messages([keys.EVENT])]
        collisions = [event for event in events if isinstance(event, Event) and event.kind == "collision"]
        if collisions:
            lines = [f"{event.text}, at {event.t_ns / 1e9:.2f} s" for event in collisions[:NAMED_MAX]]
            omitted = [f"and {len(collisions) - NAMED_MAX} more"] if len(collisions) > NAMED_MAX else []
            raise AssertionError("\n".join([*lines, *omitted, f"the record is {run.record}"]))

    def assert_same_bits(self, other: "Assertions | Run | str | Path") -> None:
        """Assert that the truth of another run is bit-identical to that of this run.

        Args:
            other: another federation, a run, or the path of one.

        Raises:
            AssertionError: it is not; the message gives the drone, time and size of the first difference.
        """
        __tracebackhide__ = True
        from zsim_api.recorded import Run

        own_run = self.run()
        other_run = other.run() if isinstance(other, Assertions) else other if isinstance(other, Run) else Run(other)
        if own_run.truth_sha256 != other_run.truth_sha256:
            raise AssertionError(
                f"{_difference(own_run, other_run)}\nthe records are {own_run.record} and {other_run.record}"
            )


def _difference(own_run: "Run", other_run: "Run") -> str:
    if own_run.drones != other_run.drones:
        return f"the drones are {', '.join(own_run.drones)}; those of the other run are {', '.join(other_run.drones)}"
    comparison = TruthComparison(own_run.drones)
    with RecordReader(own_run.record) as own_reader, RecordReader(other_run.record) as other_reader:
        for a, b in zip_longest(*(gates(reader, list(own_run.drones)) for reader in (own_reader, other_reader))):
            if a is None:
                return f"truth is the same until this run ends, before t = {b.t_ns / 1e9:.2f} s"
            if b is None:
                return f"truth is the same until the other run ends, before t = {a.t_ns / 1e9:.2f} s"
            if a.t_ns != b.t_ns:
                return f"gates differ: t = {a.t_ns / 1e9:.3f} s, and {b.t_ns / 1e9:.3f} s in the other run"
            comparison.add(a.t_ns, b.truth, a.truth)
            if comparison.first:
                return f"truth is not the same: it first differs from the other run's for {comparison.first}"
    return "the recorded truth is the same, but its hash is not: one of the records is not complete"
