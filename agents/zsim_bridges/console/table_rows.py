"""How often sensors come, from counts that are seen now and then. Pure.

What the tables tell of drones and their sensors, from what has been heard.

What the console shows, as plain data: for programs, and for tests. Read in another thread than that which draws.
"""

import math
from collections.abc import Mapping
from typing import Any

from zsim.contract.messages import EstimateView, Fault, ViewCluster, ViewDrones
from zsim_bridges.console import html_tables
from zsim_bridges.console.page.picture import FormationShape
from zsim_bridges.console.time_monitor import TimeMonitor
from zsim_bridges.console.view_buffer import ReceivedEstimate, ViewBuffer

SPAN_NS = 1_000_000_000  # simulated, over which at least a rate is taken

Counts = dict[str, tuple[int, int]]


class SensorRates:
    """Rates of one drone at a time: the one that is looked at."""

    def __init__(self) -> None:
        self._drone = ""
        self._marks: list[tuple[int, Counts]] = []

    def update(self, drone: str, t_ns: int, counts: Mapping[str, tuple[int, int]]) -> dict[str, float]:
        """Take the counts (used, refused) of a drone's sensors at an instant; return the rates [Hz] lately."""
        if drone != self._drone or self._has_restarted(t_ns, counts):
            self._drone, self._marks = drone, []
        if self._marks and self._marks[-1][0] == t_ns:
            self._marks.pop()  # the run stands still
        self._marks.append((t_ns, dict(counts)))
        while len(self._marks) > 2 and t_ns - self._marks[1][0] >= SPAN_NS:
            self._marks.pop(0)
        since_ns, before = self._marks[0]
        span_ns = t_ns - since_ns
        if span_ns <= 0:
            return {}
        return {kind: (sum(now) - sum(before.get(kind, now))) * 1e9 / span_ns for kind, now in counts.items()}

    def _has_restarted(self, t_ns: int, counts: Mapping[str, tuple[int, int]]) -> bool:
        """Tell whether a replay has gone back, or an estimator has begun anew."""
        if not self._marks:
            return False
        last_ns, last = self._marks[-1]
        return t_ns < last_ns or any(sum(counts.get(kind, (0, 0))) < sum(before) for kind, before in last.items())


class TableRows:
    """Makes rows of tables.

    Args:
        views: has heard it.
    """

    def __init__(self, views: ViewBuffer) -> None:
        self._views = views
        self._rates = SensorRates()

    def drone_rows(self) -> list[html_tables.DroneRow]:
        """Return a row for each drone."""
        view, beliefs, found = self._views.drones, self._views.estimates(), []
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
        now_ns = self._views.drones.t_ns if self._views.drones else 0
        return [fault for fault in self._views.faults if _is_active(fault, now_ns)]

    def sensor_table(self, drone: str) -> str:
        """Return the table of one drone's sensors."""
        belief = self._views.estimates().get(drone)
        if belief is None:
            return html_tables.sensor_table(drone, (), "no estimate yet")
        estimate = belief.estimate
        rates = self._rates.update(drone, belief.t_ns, estimate.sensors) if belief.fresh else {}
        rows = [html_tables.SensorRow(kind, *counts, rates.get(kind)) for kind, counts in estimate.sensors.items()]
        return html_tables.sensor_table(drone, rows, _uncertainty(belief))

    def _lag_ms(self, belief: ReceivedEstimate, now_ns: int) -> float:
        """Return how far an estimator is behind: as it says of itself, or as its view shows where that is old."""
        health = self._views.healths.get(belief.process)
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


EVENTS_MAX = 20
SILENT = "silent"  # in place of the clock's state, where the world answers nothing


def console_state(
    run_id: str, views: ViewBuffer, time_monitor: TimeMonitor, shapes: Mapping[str, FormationShape | None]
) -> dict[str, Any]:
    """Return what is shown of a run.

    Args:
        run_id: of the run.
        views: have heard it.
        time_monitor: knows how its time goes.
        shapes: the formations as they truly stand.
    """
    view, clock, clusters = views.drones, time_monitor.clock, dict(views.clusters)
    silent_s = time_monitor.silent_s
    return {
        "run_id": run_id,
        "t_s": view.t_ns / 1e9 if view else 0.0,
        "clock": SILENT if silent_s else clock.state if clock else None,
        "silent_s": silent_s,
        "drones": _drones(view, views) if view else [],
        "clusters": [_cluster(name, each, shapes.get(name)) for name, each in clusters.items()],
        "faults": [_fault(fault) for fault in views.faults],
        "events": [{"t_s": e.t_ns / 1e9, "kind": e.kind, "text": e.text} for e in list(views.events)[:EVENTS_MAX]],
    }


def _drones(view: ViewDrones, views: ViewBuffer) -> list[dict[str, Any]]:
    sigmas = {name: sigma_m(belief.estimate) for name, belief in views.estimates().items() if belief.fresh}
    return [
        {"name": d.name, "position_m": list(d.position_m), "state": d.state, "sigma_m": sigmas.get(d.name)}
        for d in view.drones
    ]


def _fault(fault: Fault) -> dict[str, Any]:
    until_s = None if fault.until_ns is None else fault.until_ns / 1e9
    about = {"id": fault.id, "kind": fault.kind, "target": fault.target}
    return {**about, "from_s": fault.from_ns / 1e9, "until_s": until_s}


def _cluster(name: str, view: ViewCluster, found: FormationShape | None) -> dict[str, Any]:
    return {
        "name": name,
        "phase": view.phase,
        "reason": view.reason,
        "desired": dict(zip(view.names, view.desired, strict=True)),
        "value": dict(zip(view.names, view.value, strict=True)),
        "true": {} if found is None else dict(zip(view.names, found.c.tolist(), strict=True)),
    }
