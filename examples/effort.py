"""Custom metrics of a sweep: the control effort of a formation, and the consistency of its estimators.

    PYTHONPATH=examples zsim sweep scenarios/step.yaml --vary gains.proportional_1_s=0.4,0.8 --vary seed=paired \
        --runs 8 --set report.metrics=effort:effort

See docs/sweep.md.
"""

import numpy as np

from zsim_analysis.reading.drone_errors import estimate_errors
from zsim_analysis.reading.formation import formations_of
from zsim_analysis.reading.recorded_flight import RecordedFlight


def effort(flight: RecordedFlight) -> dict[str, float | None]:
    """Return the RMS over drones and time of the commanded velocity [m/s], and the mean NEES of the estimates.

    Both cover the time from engagement onwards, and are None if the formation never engaged. The NEES (normalised
    estimation error squared) of an estimator that reports its true covariance is 6 on average.
    """
    engaged_s = formations_of(flight)[0].engaged_s
    if engaged_s is None:
        return {"command_rms_m_s": None, "nees": None}
    commanded = [each.velocity[each.t_ns >= engaged_s * 1e9] for each in flight.commands.values()]
    nees = [each.nees[each.t_s >= engaged_s] for each in estimate_errors(flight).values()]
    squares = np.sum(np.concatenate(commanded) ** 2, axis=1)
    return {"command_rms_m_s": float(np.sqrt(squares.mean())), "nees": float(np.nanmean(np.concatenate(nees)))}
