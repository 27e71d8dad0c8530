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
    """Assertions about a run; each of them first lets the run fly to its end."""

    @abstractmethod
    def run(self) -> "Run":
        """Return the recorded run."""

    def assert_errors(
        self, window: tuple[float, float] | None = None, cluster: str | None = None, **rms: float
    ) -> None:
        """Assert the true errors of a formation: the RMS of truth − desired while it is engaged.

        Args:
            window: start and end [s]; None: that of the report.
            cluster: name; None: the first.
            rms: largest allowed RMS of each cluster variable [m, rad], such as p=0.3.

        Raises:
            AssertionError: an RMS is larger or unknown (one line for each, with the largest error and its time), the
                run ended before the window did, or the formation was not engaged throughout the window.
        """
        __tracebackhide__ = True  # pytest then shows the line of the test, not this function
        run = self.run()
        formation = run.judged_formation(cluster)
        window = window or run.summary.window_s
        where = f"{formation.name} from {window[0]:g} to {window[1]:g} s"
        if unknown := [name for name in rms if name not in formation.names]:
            raise RunError(f"{where}: has no variable {unknown[0]!r}; must be one of {', '.join(formation.names)}")
        share, found, faults = formation.engaged_share(window), formation.errors(window), []
        if window[1] > run.duration_s:
            faults.append(f"{where}: the run ended at {run.duration_s:g} s")
        elif share != 1.0:
            faults.append(f"{where}: was engaged {share or 0:.0%} of the time; must be all of it")
        for name, allowed in rms.items():
            error = found[name].true_rms
            if error is None:
                faults.append(f"{where}: true RMS of {name} is unknown")
            elif not error <= allowed:
                errors = np.where(
                    formation.judged(window), np.abs(formation.true_error[:, formation.column(name)]), 0.0
                )
                row = int(np.nanargmax(errors))
                most = f"the largest error is {errors[row]:.3g}, at {formation.t_s[row]:.2f} s"
                faults.append(
                    f"{where}: true RMS of {name} is {error:.3g} {unit(name)}; must be at most {allowed:g}; {most}"
                )
        if faults:
            raise AssertionError("\n".join([*faults, f"the record is {run.record}"]))

    def assert_no_collision(self) -> None:
        """Assert that no drone collided with another drone or an obstacle; the AssertionError says which, and when."""
        __tracebackhide__ = True
        run = self.run()
        with RecordReader(run.record) as reader:
            events = [decode_or_none(recorded) for recorded in reader.messages([keys.EVENT])]
        found = [event for event in events if isinstance(event, Event) and event.kind == "collision"]
        if found:
            lines = [f"{event.text}, at {event.t_ns / 1e9:.2f} s" for event in found[:NAMED_MAX]]
            more = [f"and {len(found) - NAMED_MAX} more"] if len(found) > NAMED_MAX else []
            raise AssertionError("\n".join([*lines, *more, f"the record is {run.record}"]))

    def assert_same_bits(self, other: "Assertions | Run | str | Path") -> None:
        """Assert that the truth of another run is bit-identical to that of this run.

        Args:
            other: another federation, a run, or the path of one.

        Raises:
            AssertionError: it is not; the message gives the drone, time and size of the first difference.
        """
        __tracebackhide__ = True
        from zsim_api.recorded import Run

        ours = self.run()
        theirs = other.run() if isinstance(other, Assertions) else other if isinstance(other, Run) else Run(other)
        if ours.truth_sha256 != theirs.truth_sha256:
            raise AssertionError(f"{_difference(ours, theirs)}\nthe records are {ours.record} and {theirs.record}")


def _difference(ours: "Run", theirs: "Run") -> str:
    if ours.drones != theirs.drones:
        return f"the drones are {', '.join(ours.drones)}; those of the other run are {', '.join(theirs.drones)}"
    comparison = TruthComparison(ours.drones)
    with RecordReader(ours.record) as one, RecordReader(theirs.record) as two:
        for a, b in zip_longest(*(gates(reader, list(ours.drones)) for reader in (one, two))):
            if a is None:
                return f"truth is the same until this run ends, before t = {b.t_ns / 1e9:.2f} s"
            if b is None:
                return f"truth is the same until the other run ends, before t = {a.t_ns / 1e9:.2f} s"
            if a.t_ns != b.t_ns:
                return f"gates differ: t = {a.t_ns / 1e9:.3f} s, and {b.t_ns / 1e9:.3f} s in the other run"
            comparison.add(a.t_ns, b.truth, a.truth)
            if comparison.first:
                return f"truth is not the same: it first differs from the other run's for {comparison.first}"
    return "truth on record is the same, but its hash is not: one of the records is not complete"
