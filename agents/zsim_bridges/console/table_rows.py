"""What the tables tell of drones and their sensors, from what has been heard."""

import math

from zsim.contract.messages import EstimateView, Fault
from zsim_bridges.console import html_tables
from zsim_bridges.console.sensor_rates import SensorRates
from zsim_bridges.console.view_buffer import ReceivedEstimate, ViewBuffer


class TableRows:
    """Makes rows of tables.

    Args:
        eyes: has heard it.
    """

    def __init__(self, eyes: ViewBuffer) -> None:
        self._eyes = eyes
        self._rates = SensorRates()

    def drone_rows(self) -> list[html_tables.DroneRow]:
        """Return a row for each drone."""
        view, beliefs, found = self._eyes.drones, self._eyes.estimates(), []
        if view is None:
            return []
        active_faults = self._active()
        for drone in view.drones:
            belief = beliefs.get(drone.name)
            gps = belief.estimate.sensors.get("gps") if belief else None
            faults = tuple(fault.kind for fault in active_faults if fault.target == drone.name)
            told = "–" if gps is None else f"{gps[0]} / {gps[1]}"
            lag = self._lag_ms(belief, view.t_ns) if belief else None
            row = (drone.name, drone.state, drone.battery_percent, lag, drone.commander, told, faults)
            found.append(html_tables.DroneRow(*row))
        return found

    def acting(self) -> list[str]:
        """Return which faults act, and on what."""
        return [f"{fault.kind} of {fault.target}{_end_text(fault)}" for fault in self._active()]

    def _active(self) -> list[Fault]:
        now_ns = self._eyes.drones.t_ns if self._eyes.drones else 0
        return [fault for fault in self._eyes.faults if _is_active(fault, now_ns)]

    def sensor_table(self, drone: str) -> str:
        """Return the table of one drone's sensors."""
        belief = self._eyes.estimates().get(drone)
        if belief is None:
            return html_tables.sensor_table(drone, (), "no estimate yet")
        estimate = belief.estimate
        rates = self._rates.update(drone, belief.t_ns, estimate.sensors) if belief.fresh else {}
        rows = [html_tables.SensorRow(kind, *counts, rates.get(kind)) for kind, counts in estimate.sensors.items()]
        return html_tables.sensor_table(drone, rows, _uncertainty(belief))

    def _lag_ms(self, belief: ReceivedEstimate, now_ns: int) -> float:
        """Return how far an estimator is behind: as it says of itself, or as its view shows where that is old."""
        health = self._eyes.healths.get(belief.process)
        if health is not None and belief.fresh:
            return health.lag_ns / 1e6
        return max(0, now_ns - belief.t_ns) / 1e6


def _is_active(fault: Fault, now_ns: int) -> bool:
    return fault.from_ns <= now_ns and (fault.until_ns is None or fault.until_ns > now_ns)


def _end_text(fault: Fault) -> str:
    return "" if fault.until_ns is None else f" until {fault.until_ns / 1e9:.1f} s"


def _uncertainty(belief: ReceivedEstimate) -> str:
    """Return in words how sure an estimator is."""
    if not belief.fresh:
        return f"no estimate since {belief.t_ns / 1e9:.1f} s"
    heading_deg = math.degrees(belief.estimate.yaw_sigma_rad)
    return f"σ of position {sigma_m(belief.estimate):.2f} m, of heading {heading_deg:.1f}°"


def sigma_m(estimate: EstimateView) -> float:
    """Return the root of the mean variance of the position over its axes; 0 where that is negative, so none."""
    xx, _, _, yy, _, zz = estimate.covariance_m2
    return math.sqrt(max(0.0, xx + yy + zz) / 3)
