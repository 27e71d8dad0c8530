"""Synthetic rows of sweeps, whose errors are a function of the run's number."""

import io
from typing import Any

from rich.console import Console

from zsim.math.randomness import stream
from zsim_analysis.sweep.design import SweepDesign, SweepPlan
from zsim_analysis.sweep.sweep_run import Row, RunResult, make_row

NAMES = ("x_c", "y_c", "beta")


def plan(*vary: str, runs: int = 1, **values: Any) -> SweepPlan:
    return SweepPlan(source="s.yaml", document={"name": "s", **values}, vary=vary, runs=runs)


def made(of: SweepPlan, run: int, failure: str | None = None, **known: Any) -> Row:
    """Return a row as a flight would, with errors that are a function of the run's number."""
    design = SweepDesign(of)
    values = design.values(run)
    result = RunResult(run=run, point=design.point(run), seed=values.get("seed", 1), failure=failure, host="h", **known)
    rng = stream(run, "error")
    errors = {f"errors.{name}.{each}": abs(rng.normal(0.1, 0.02)) for name in NAMES for each in ("est_std", "true_rms")}
    return make_row(result, {path: values[path] for path in design.varied}, {} if failure else errors)


def well(of: SweepPlan, run: int) -> Row:
    more = {"ended": "over", "sim_s": 5.0, "wall_s": 0.5, "real_time_factor": 10.0}
    return made(of, run, truth_sha256=f"{run:064x}", min_separation_m=2 + 0.1 * (run % 7), collisions=0, **more)


def printed(renderable: Any, width: int) -> str:
    """Return what a terminal with `width` columns shows."""
    file = io.StringIO()
    Console(file=file, width=width).print(renderable)
    return file.getvalue()
