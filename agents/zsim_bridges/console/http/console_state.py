"""What the console shows, as plain data: for programs, and for tests. Read in another thread than that which draws."""

from collections.abc import Mapping
from typing import Any

from zsim.contract.messages import Fault, ViewCluster, ViewDrones
from zsim_bridges.console.scene.picture import FormationShape
from zsim_bridges.console.table_rows import sigma_m
from zsim_bridges.console.time_monitor import TimeMonitor
from zsim_bridges.console.view_buffer import ViewBuffer

EVENTS_MAX = 20
SILENT = "silent"  # in place of the clock's state, where the world answers nothing


def console_state(run_id: str, eyes: ViewBuffer, watch: TimeMonitor, shapes: Mapping[str, FormationShape | None]) -> dict[str, Any]:
    """Return what is shown of a run.

    Args:
        run_id: of the run.
        eyes: have heard it.
        watch: knows how its time goes.
        shapes: the formations as they truly stand.
    """
    view, clock, clusters = eyes.drones, watch.clock, dict(eyes.clusters)
    silent_s = watch.silent_s
    return {
        "run_id": run_id,
        "t_s": view.t_ns / 1e9 if view else 0.0,
        "clock": SILENT if silent_s else clock.state if clock else None,
        "silent_s": silent_s,
        "drones": _drones(view, eyes) if view else [],
        "clusters": [_cluster(name, each, shapes.get(name)) for name, each in clusters.items()],
        "faults": [_fault(fault) for fault in eyes.faults],
        "events": [{"t_s": e.t_ns / 1e9, "kind": e.kind, "text": e.text} for e in list(eyes.events)[:EVENTS_MAX]],
    }


def _drones(view: ViewDrones, eyes: ViewBuffer) -> list[dict[str, Any]]:
    sigmas = {name: sigma_m(belief.estimate) for name, belief in eyes.estimates().items() if belief.fresh}
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
