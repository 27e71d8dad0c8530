"""What the console shows, as rows of tables and as plain data for programs, from the newest views."""

import math
from collections.abc import Mapping
from typing import Any

from zsim.contract.run_messages import Fault
from zsim.contract.views import EstimateView, ViewCluster, ViewDrones
from zsim_bridges.console import html_tables
from zsim_bridges.console.page.picture import FormationShape
from zsim_bridges.console.time_monitor import TimeMonitor
from zsim_bridges.console.view_buffer import ReceivedEstimate, ViewBuffer

SPAN_NS = 1_000_000_000  # simulated, over which at least a rate is taken

Counts = dict[str, tuple[int, int]]


class SensorRates:
    """Sensor rates of one drone at a time, from counts that are sampled now and then."""

    def __init__(self) -> None:
        self._drone = ""
        self._samples: list[tuple[int, Counts]] = []

    def update(self, drone: str, t_ns: int, counts: Mapping[str, tuple[int, int]]) -> dict[str, float]:
        """Add the counts (used, refused) of a drone's sensors at an instant; return the latest rates [Hz]."""
        if drone != self._drone or self._has_restarted(t_ns, counts):
            self._drone, self._samples = drone, []
        if self._samples and self._samples[-1][0] == t_ns:
            self._samples.pop()  # the run stands still
        self._samples.append((t_ns, dict(counts)))
        while len(self._samples) > 2 and t_ns - self._samples[1][0] >= SPAN_NS:
            self._samples.pop(0)
        since_ns, before = self._samples[0]
        span_ns = t_ns - since_ns
        if span_ns <= 0:
            return {}
        return {kind: (sum(now) - sum(before.get(kind, now))) * 1e9 / span_ns for kind, now in counts.items()}

    def _has_restarted(self, t_ns: int, counts: Mapping[str, tuple[int, int]]) -> bool:
        """Return whether a replay has gone back, or an estimator has restarted."""
        if not self._samples:
            return False
        last_ns, last = self._samples[-1]
        return t_ns < last_ns or any(sum(counts.get(kind, (0, 0))) < sum(before) for kind, before in last.items())


class TableRows:
    """Makes rows of tables.

    Args:
        views: the newest ones.
    """

    def __init__(self, views: ViewBuffer) -> None:
        self._views = views
        self._rates = SensorRates()

    def drone_rows(self) -> list[html_tables.DroneRow]:
        """Return a row for each drone."""
        view, estimates, rows = self._views.drones, self._views.estimates(), []
        if view is None:
            return []
        faults = self._active()
        for drone in view.drones:
            received = estimates.get(drone.name)
            gps = received.estimate.sensors.get("gps") if received else None
            own_faults = tuple(fault.kind for fault in faults if fault.target == drone.name)
            fixes = "–" if gps is None else f"{gps[0]} / {gps[1]}"
            lag = self._lag_ms(received, view.t_ns) if received else None
            row = (drone.name, drone.state, drone.battery_percent, lag, drone.commander, fixes, own_faults)
            rows.append(html_tables.DroneRow(*row))
        return rows

    def active_faults(self) -> list[str]:
        """Return kind and target of each active fault."""
        return [f"{fault.kind} of {fault.target}{_end_text(fault)}" for fault in self._active()]

    def _active(self) -> list[Fault]:
        now_ns = self._views.drones.t_ns if self._views.drones else 0
        return [fault for fault in self._views.faults if _is_active(fault, now_ns)]

    def sensor_table(self, drone: str) -> str:
        """Return the table of one drone's sensors."""
        received = self._views.estimates().get(drone)
        if received is None:
            return html_tables.sensor_table(drone, (), "no estimate yet")
        estimate = received.estimate
        rates = self._rates.update(drone, received.t_ns, estimate.sensors) if received.fresh else {}
        rows = [html_tables.SensorRow(kind, *counts, rates.get(kind)) for kind, counts in estimate.sensors.items()]
        return html_tables.sensor_table(drone, rows, _uncertainty(received))

    def _lag_ms(self, received: ReceivedEstimate, now_ns: int) -> float:
        """Return how far an estimator is behind: by its health, or by its view where that is old."""
        health = self._views.healths.get(received.process)
        if health is not None and received.fresh:
            return health.lag_ns / 1e6
        return max(0, now_ns - received.t_ns) / 1e6


def _is_active(fault: Fault, now_ns: int) -> bool:
    return fault.from_ns <= now_ns and (fault.until_ns is None or fault.until_ns > now_ns)


def _end_text(fault: Fault) -> str:
    return "" if fault.until_ns is None else f" until {fault.until_ns / 1e9:.1f} s"


def _uncertainty(received: ReceivedEstimate) -> str:
    """Return an estimator's uncertainty in words."""
    if not received.fresh:
        return f"no estimate since {received.t_ns / 1e9:.1f} s"
    heading_deg = math.degrees(received.estimate.yaw_sigma_rad)
    return f"σ of position {sigma_m(received.estimate):.2f} m, of heading {heading_deg:.1f}°"


def sigma_m(estimate: EstimateView) -> float:
    """Return the root of the mean variance of the position over its axes; 0 where that is negative, so none."""
    xx, _, _, yy, _, zz = estimate.covariance_m2
    return math.sqrt(max(0.0, xx + yy + zz) / 3)


EVENTS_MAX = 20
SILENT = "silent"  # in place of the clock's state, where the world answers nothing


def console_state(
    run_id: str, views: ViewBuffer, time_monitor: TimeMonitor, shapes: Mapping[str, FormationShape | None]
) -> dict[str, Any]:
    """Return what is shown of a run, as plain data; called in another thread than that which draws.

    Args:
        run_id: of the run.
        views: the newest ones.
        time_monitor: of the run's clock.
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
    sigmas = {name: sigma_m(received.estimate) for name, received in views.estimates().items() if received.fresh}
    return [
        {"name": d.name, "position_m": list(d.position_m), "state": d.state, "sigma_m": sigmas.get(d.name)}
        for d in view.drones
    ]


def _fault(fault: Fault) -> dict[str, Any]:
    until_s = None if fault.until_ns is None else fault.until_ns / 1e9
    about = {"id": fault.id, "kind": fault.kind, "target": fault.target}
    return {**about, "from_s": fault.from_ns / 1e9, "until_s": until_s}


def _cluster(name: str, view: ViewCluster, true_shape: FormationShape | None) -> dict[str, Any]:
    return {
        "name": name,
        "phase": view.phase,
        "reason": view.reason,
        "desired": dict(zip(view.names, view.desired, strict=True)),
        "value": dict(zip(view.names, view.value, strict=True)),
        "true": {} if true_shape is None else dict(zip(view.names, true_shape.c.tolist(), strict=True)),
    }
