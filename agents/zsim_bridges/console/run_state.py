"""What the console shows of a run, as plain data for programs."""

from collections.abc import Mapping
from typing import Any

from zsim.contract.flight_messages import ViewCluster, ViewDrones
from zsim.contract.run_messages import Fault
from zsim_bridges.console.monitoring.time_monitor import TimeMonitor
from zsim_bridges.console.monitoring.view_buffer import ViewBuffer
from zsim_bridges.console.scene.picture import FormationShape

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
    sigmas = {name: received.sigma_m for name, received in views.estimates().items() if received.fresh}
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
