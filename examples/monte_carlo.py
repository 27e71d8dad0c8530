"""Fly a scenario with many seeds, and compare the errors of two estimators.

    python examples/monte_carlo.py scenarios/step.yaml --seeds 10 --duration 60

Like `zsim sweep`, it runs on all cores; see docs/sweep.md.
"""

import argparse

import numpy as np
from my_estimator import MyEstimator

import zsim
from zsim_analysis.reading.drone_errors import estimate_errors
from zsim_analysis.reading.recorded_flight import RecordedFlight

SETTLED_S = 10.0  # s; earlier errors are excluded, because they stem from the first fixes


def horizontal_rms_m(flight: RecordedFlight) -> float:
    """Return the RMS over drones and time of the horizontal error of the estimated positions [m]."""
    errors = [each.error[each.t_s > SETTLED_S, :2] for each in estimate_errors(flight).values()]
    return float(np.sqrt(np.mean(np.sum(np.concatenate(errors) ** 2, axis=1))))


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
parser.add_argument("scenario")
parser.add_argument("--seeds", type=int, default=10)
parser.add_argument("--duration", type=float, default=60.0)
args = parser.parse_args()
frame = zsim.sweep(
    args.scenario,
    vary={"seed": range(1, args.seeds + 1), "estimation.algorithm": ["ekf", MyEstimator]},
    metrics=[horizontal_rms_m],
    duration_s=args.duration,
)
print(frame.pivot(index="seed", columns="estimation.algorithm", values="metrics.horizontal_rms_m").round(3))
