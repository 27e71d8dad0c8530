"""Flies a scenario many times with different seeds and field values: `zsim.sweep` and `zsim sweep`."""

import json
import re
import tempfile
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from rich.console import Console

from zsim.errors import RunError, ScenarioError, what_is_missing
from zsim.output_folder import temporary_folder
from zsim.runtime.progress import cell
from zsim.scenario.scenario_file import full_path
from zsim.schema import plugin
from zsim.schema.checker import show
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.report import indented_json
from zsim_analysis.sweep.design import METRICS, SweepDesign, SweepPlan, distinct, make_plan, text_of
from zsim_analysis.sweep.sweep import TABLE, SweepFolder, SweepRequest, read_table
from zsim_analysis.sweep.sweep import sweep as swept
from zsim_analysis.sweep.sweep_run import FIXED, Row, generated_modules
from zsim_analysis.sweep.sweep_summary import SweepResults
from zsim_api.recorded import load
from zsim_api.scenarios import AnyScenario, Scenario, scenario_of, scratch_folder

if TYPE_CHECKING:
    import pandas as pd

    from zsim_api.recorded import Run

    Metric = Callable[[Run], Any] | Callable[[RecordedFlight], Any]


def sweep(
    scenario: AnyScenario,
    vary: Mapping[str, Any] = {},
    *,
    metrics: "Metric | Sequence[Metric | str]" = (),
    runs: int | None = None,
    seed: int | None = None,
    duration_s: float | None = None,
    set: Mapping[str, Any] | None = None,
    law: type | None = None,
    estimator: type | None = None,
    workers: int | None = None,
    client: Any = None,
    out: str | Path | None = None,
    keep_records: bool = False,
    progress: bool = True,
) -> "pd.DataFrame":
    """Fly every combination of values, on all cores; return a frame with a row for each run.

        frame = zsim.sweep(
            "step.yaml",
            vary={"seed": range(50), "estimation.algorithm": ["ekf", MyEstimator]},
            metrics=[settling_time],
        )
        frame.groupby("estimation.algorithm")["metrics.settling_time"].mean()

    Each run is bit-identical to `zsim.run` with the same values, wherever it is flown. Ctrl-C ends the workers and
    raises KeyboardInterrupt; finished runs are kept in the folder, where the same call with `out` continues.

    Args:
        scenario: path of a YAML file, `zsim.Scenario`, or a mapping as in YAML.
        vary: sequences of values by path, of which every combination is flown; for fields that name a class, values may
            be classes; or texts as for `--vary`, with `runs`: `{"seed": "paired", "wind.gust_m_s": "uniform(0, 2)"}`.
        metrics: functions of the run (`zsim.Run`), or their names `module:function`, that return a number or a mapping
            of numbers by name: columns `metrics.NAME`. A function whose argument is named `flight` is given the arrays
            of a `RecordedFlight` instead; this is faster, because nothing is recorded.
        runs: number of runs; None: one for each combination.
        seed, duration_s, set, law, estimator: for all runs, as in `zsim.run`.
        workers: number of processes; None: one per core.
        client: a `distributed.Client`, whose workers are used instead.
        out: folder of the sweep, which `zsim report` reads; an unfinished sweep is continued. None: a folder that is
            removed when this process ends.
        keep_records: whether the record of every run is kept, in the subfolder `runs`.
        progress: whether progress is shown.

    Returns:
        A frame indexed by run number: `seed`, the values by path, `failure` (why the run did not end well, NaN if it
        did), `metrics.NAME`, errors, and the other columns of docs/sweep.md. Missing texts and numbers are NaN, missing
        flags NA. A class appears under its name, a second one of the same name as `Law-2`. `attrs["folder"]` is the
        folder of the sweep, `attrs["summary"]` the content of summary.json of `zsim report`: means and intervals of
        each combination.

    Raises:
        ScenarioError: with one line for every fault in the values and in the scenarios.
        RunError: the folder contains something else, workers cannot start, or pandas is not installed.
    """
    with what_is_missing():
        import_module("pandas")  # before anything is flown
    console = Console(stderr=True, quiet=not progress)
    varied = scenario_of(scenario).changed(seed, duration_s, set, law, estimator)
    functions = [metrics] if callable(metrics) or isinstance(metrics, str) else list(metrics)
    if functions:
        varied = varied.with_({METRICS: functions})
    texts = [_text(path, values, varied) for path, values in vary.items()]
    varied.search()
    try:
        plan = checked_plan(varied.source, varied.document(), texts, runs, keep_records, varied.changes, console)
    except ScenarioError as error:
        raise ScenarioError([_in_python(fault) for fault in error.faults]) from None
    folder = Path(out) if out is not None else temporary_folder("sweep-")
    module_names = re.findall(rf"{plugin.MADE}\w+", msgspec.json.encode(plan).decode())  # anywhere in the plan
    modules = generated_modules(module_names, [scratch_folder()])
    try:
        rows = fly_plan(plan, folder, workers, client, console=console, modules=tuple(modules))
    except KeyboardInterrupt:
        finished = len(SweepFolder(folder, plan).rows())
        kept_folder = folder if out is not None else folder.replace(tempfile.mkdtemp(prefix="zsim-sweep-"))
        text = f"interrupted: {finished} of {plan.runs} runs are finished; out={str(kept_folder)!r} continues"
        console.print(cell(text), soft_wrap=True)
        raise
    except RunError as error:
        raise RunError(_in_python(str(error))) from None
    design = SweepDesign(plan)
    frame = _frame(read_table(folder / TABLE), design.varied)
    for path, values in vary.items():
        if labels := _labels(values, varied):
            column = full_path(path, plan.document)
            frame[column] = frame[column].replace(labels)
    frame.attrs = {"folder": str(folder), "summary": json.loads(indented_json(SweepResults(design, rows).summary()))}
    return frame


def checked_plan(
    source: str,
    document: dict[str, Any],
    vary: list[str],
    runs: int | None,
    records: bool,
    changed: Sequence[str] | None,
    console: Console,
    faults: Sequence[str] = (),
) -> SweepPlan:
    """Return the plan of a sweep from `make_plan`, showing meanwhile which combination is being checked."""
    status = console.status("checking every combination …") if console.is_terminal else None
    with status or nullcontext():

        def show_progress(run: int, total: int) -> None:
            if status:
                status.update(f"checking combination {run + 1} of {total}")

        return make_plan(source, document, vary, runs, records, show_progress, faults, changed)


def fly_plan(
    plan: SweepPlan, folder: Path, workers: int | None = None, dask: Any = None, force: bool = False, **options: Any
) -> list[Row]:
    """Fly a plan into a folder; return its rows. Arguments as in `SweepRequest`, errors as in `sweep`."""
    return swept(SweepRequest(plan, folder, workers, dask, force, open_run=partial(load, trust=True), **options))


def _text(path: str, values: Any, scenario: Scenario) -> str:
    """Return an entry of `vary` as a text for `--vary`."""
    if isinstance(values, str):
        return f"{path}={values}"
    values = values.tolist() if isinstance(values, np.ndarray) else values
    if isinstance(values, Mapping) or not isinstance(values, Iterable):
        rule = "must be a sequence of values, or a text such as 'uniform(0, 2)'"
        raise ScenarioError([f"vary {path} is {show(values)}; {rule}"])
    try:
        return f"{path}={','.join(json.dumps(scenario.named(value)) for value in values)}"
    except TypeError as error:
        raise ScenarioError([f"vary {path}: {error}; must be values as in YAML, or classes"]) from error


_DTYPES: dict[Any, Any] = {str: str, str | None: str, bool | None: "boolean", int | None: float, float | None: float}


def _frame(rows: Sequence[Row], varied: Collection[str]) -> "pd.DataFrame":
    """Return rows as a frame indexed by run number; missing texts and numbers are NaN, missing flags NA."""
    import pandas as pd

    columns: dict[str, pd.Series] = {}
    for name in rows[0]:
        dtype = None if name in varied else _DTYPES.get(FIXED.get(name, float | None))
        values = [row[name] for row in rows]
        # some versions of pandas turn None into a text
        columns[name] = pd.Series([np.nan if v is None else v for v in values] if dtype is str else values, dtype=dtype)
    return pd.DataFrame(columns).set_index("run")


def _labels(values: Any, scenario: Scenario) -> dict[str, str]:
    """Return labels for the classes and functions among values, by their names in the scenario."""
    entries = [] if isinstance(values, str) else [*values]
    texts = [text_of(scenario.named(value)) for value in entries]
    generated = {index: value.__name__ for index, value in enumerate(entries) if hasattr(value, "__name__")}
    labels = distinct(texts, generated)
    return {texts[index]: labels[index] for index in generated}


def _in_python(line: str) -> str:
    """Return an error line with arguments named as in Python, not as options."""
    return re.sub(r"--(?=(vary|runs|out|set)\b)", "", line)
