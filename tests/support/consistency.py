"""Feeding an estimator with a fleet's samples, and the band in which its normalised errors must lie."""

from typing import Any

from fleet_samples import SensorSample
from scipy.stats import chi2

from zsim.contract import messages
from zsim_agents.estimation.estimator_bank import EstimatorBank
from zsim_world.fleet.fleet import GPS_FIX


def feed(bank: EstimatorBank, sample: SensorSample, gps_sigma_m: float) -> None:
    v: Any = sample.values
    stamps = (sample.t_ns, 0, sample.t_sample_ns)
    match sample.sensor:
        case "imu":
            message = messages.Imu(*stamps, v[:3], v[3:6])
        case "gps":
            message = messages.Gps(*stamps, v[0], v[1], v[2], v[3:6], v[6:9], gps_sigma_m, GPS_FIX, 9)
        case "mag":
            message = messages.Mag(*stamps, v[:3])
        case "baro":
            message = messages.Baro(*stamps, v[0], v[1])
        case "sonar":
            message = messages.Sonar(*stamps, v[0], bool(v[1]))
        case _:
            message = messages.Flow(*stamps, v[:3], v[3])
    bank.receive(sample.drone, sample.sensor, message, sample.t_ns * 1e-9)


def band(dof: int, runs: int) -> tuple[float, float]:
    """Return the 95 % band of the mean NEES over independent runs."""
    low, high = chi2.ppf([0.025, 0.975], dof * runs) / runs
    return float(low), float(high)
