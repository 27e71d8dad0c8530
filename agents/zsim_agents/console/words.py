"""What the tables tell of drones and their sensors, from what has been heard."""

import math

from zsim.messages import EstimateView
from zsim_agents.console import tables
from zsim_agents.console.eyes import Eyes
from zsim_agents.console.rates import Rates


class Words:
    """Makes rows of tables.

    Args:
        eyes: has heard it.
    """

    def __init__(self, eyes: Eyes) -> None:
        self._eyes = eyes
        self._rates = Rates()

    def rows(self) -> list[tables.Row]:
        """Return a row for each drone."""
        view, estimates, lags = self._eyes.drones, self._eyes.estimates(), self._lags_ms()
        found = []
        for drone in view.drones if view else ():
            gps = estimates[drone.name].sensors.get("gps") if drone.name in estimates else None
            faults = tuple(f.kind for f in self._eyes.faults if f.target == drone.name)
            told = "–" if gps is None else f"{gps[0]} / {gps[1]}"
            lag = lags.get(drone.name)
            row = (drone.name, drone.state, drone.battery_percent, lag, drone.commander, told, faults)
            found.append(tables.Row(*row))
        return found

    def sensors(self, drone: str) -> str:
        """Return the table of one drone's sensors."""
        views = list(self._eyes.estimators.values())
        found = next(((v.t_ns, e) for v in views for e in v.estimates if e.name == drone), None)
        if found is None:
            return tables.sensors(drone, (), None, None)
        t_ns, estimate = found
        rates = self._rates.of(drone, t_ns, estimate.sensors)
        rows = [tables.SensorRow(kind, *counts, rates.get(kind)) for kind, counts in estimate.sensors.items()]
        return tables.sensors(drone, rows, sigma_m(estimate), math.degrees(estimate.yaw_sigma_rad))

    def _lags_ms(self) -> dict[str, float]:
        """Return how far each drone's estimator is behind, as it says of itself or as its view shows."""
        now_ns = self._eyes.drones.t_ns if self._eyes.drones else 0
        found = {}
        for process, view in self._eyes.estimators.items():
            health = self._eyes.healths.get(process)
            lag_ns = health.lag_ns if health else max(0, now_ns - view.t_ns)
            found |= {estimate.name: lag_ns / 1e6 for estimate in view.estimates}
        return found


def sigma_m(estimate: EstimateView) -> float:
    """Return the root of the mean variance of the position over its axes."""
    xx, _, _, yy, _, zz = estimate.covariance_m2
    return math.sqrt((xx + yy + zz) / 3)
