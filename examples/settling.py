"""Custom metrics of a sweep: the settling time and the overshoot of the formation's side p.

    PYTHONPATH=examples zsim sweep scenarios/step.yaml --vary wind.gust_m_s=0,1 --set report.metrics=settling:settling

See docs/sweep.md.
"""

import numpy as np
from numpy.typing import NDArray

from zsim_analysis.reading.formation import formations_of
from zsim_analysis.reading.recorded_flight import RecordedFlight

BAND_M = 0.5  # m; a side has settled once it stays this close to its desired length; an assumption


def settling(flight: RecordedFlight) -> dict[str, float | None]:
    """Return when side p settled [s after engagement], and its largest excess over the desired length [m].

    Both are None if the formation never engaged; the time is None if the side never settled.
    """
    formation = formations_of(flight)[0]
    if formation.engaged_s is None:
        return {"settled_s": None, "overshoot_m": None}
    since = formation.since_engaged
    error_m = formation.true_error[since, formation.column("p")]
    return settled(formation.t_s[since], error_m, formation.engaged_s)


def settled(t_s: NDArray[np.float64], error_m: NDArray[np.float64], engaged_s: float) -> dict[str, float | None]:
    """Return the metrics of an error (K,) [m] at times (K,) [s]."""
    outside = np.flatnonzero(np.abs(error_m) > BAND_M)
    first = outside[-1] + 1 if len(outside) else 0
    settled_s = float(t_s[first]) - engaged_s if first < len(t_s) else None
    return {"settled_s": settled_s, "overshoot_m": float(np.nanmax(error_m))}
