"""A run on record, as tables, errors and figures: `zsim.load`.

    run = zsim.load("runs/step-20260101-120000")
    run.truth("drone1").position_m_z.plot()
    run.errors()

A table has the columns that `zsim export` writes; its index is simulated time. Nothing is read before it is asked for.
"""

import html
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zsim.contract import keys
from zsim.errors import RunError
from zsim.output_folder import record_at
from zsim.record import RecordReader
from zsim.schema.checker import suggestion
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.export.columns import DecodedMessages, MessageSelection, TableSurvey, batches
from zsim_analysis.reading.drone_errors import EstimateErrors, estimate_errors
from zsim_analysis.reading.formation import Formation, ParameterErrors
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.reading.shortfall import Shortfall

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure

    from zsim_analysis.report.summary import RunSummary

COMMANDS = ("velocity", "ardrone", "attitude", "rotors", "mode")  # drone/{d}/cmd/...
DROPPED = ("name", "t_ns")  # the first is in the question, the second in the index


def load(place: str | Path) -> "Run":
    """Return a run on record, of any kind: in one process, as processes, on several hosts, or interrupted.

    Args:
        place: the folder of a run, or its run.mcap.

    Raises:
        RunError: there is no record.
        RecordError: the file is no record of zsim's.
    """
    return Run(Path(place))


class Run:
    """A run on record.

    Tables are pandas frames with simulated time in seconds as index, `t_s`; units are in the names of the columns.
    Without pandas they are maps of numpy arrays by column.

    Attributes:
        folder: of the run.
        record: the file.
    """

    def __init__(self, place: Path) -> None:
        self.record = record_at(place)
        self.folder = self.record.parent
        self._tables: dict[str, Any] = {}
        with RecordReader(self.record) as reader:
            self.keys = sorted(reader.topics())

    # Tables

    def truth(self, drone: str) -> "pandas.DataFrame":
        """Return the true motion of a drone, at every gate; W, B and rotors in the order of `world/info`."""
        return self._of_drone(drone, "truth")

    def estimate(self, drone: str) -> "pandas.DataFrame":
        """Return the estimates of a drone's motion, with their covariance."""
        return self._of_drone(drone, "estimate")

    def sensor(self, drone: str, sensor: str) -> "pandas.DataFrame":
        """Return the samples of a sensor: "imu", "gps", "mag", "baro", "sonar", "flow", or one of your own."""
        return self._of_drone(drone, f"sensor/{sensor}", "sensor")

    def status(self, drone: str) -> "pandas.DataFrame":
        """Return the state of a drone's firmware and battery, at every gate."""
        return self._of_drone(drone, "sensor/status")

    def commands(self, drone: str, kind: str = "velocity") -> "pandas.DataFrame":
        """Return the commands to a drone of a kind: "velocity", "ardrone", "attitude", "rotors" or "mode"."""
        if kind not in COMMANDS:
            raise RunError(f"kind of commands is {kind!r}; {suggestion(kind, COMMANDS)}must be one of {COMMANDS}")
        return self._of_drone(drone, f"cmd/{kind}", "cmd")

    def cluster(self, cluster: str = "main") -> "pandas.DataFrame":
        """Return the states of a formation as its controller saw it: phase, measured and desired variables."""
        return self._table(keys.cluster_state(cluster))

    def formation(self, cluster: str = "main") -> "pandas.DataFrame":
        """Return the variables of a formation, `desired_x_c_m`, `estimate_x_c_m`, `truth_x_c_m`; NaN where unknown.

        Raises:
            RunError: no formation of that name can be judged.
        """
        found = next((each for each in self._formations if each.name == cluster), None)
        if found is None:
            raise RunError(_unknown("formation", cluster, [each.name for each in self._formations], self.record))
        parts = {"desired": found.desired, "estimate": found.value, "truth": found.true}
        columns: dict[str, Any] = {
            f"{what}_{name}_{unit(name)}": values[:, i]
            for i, name in enumerate(found.names)
            for what, values in parts.items()
        }
        return _frame({"t_s": found.t_s, "phase": np.array(found.phases, object), **columns})

    def messages(self, key: str) -> "pandas.DataFrame":
        """Return all messages of a key, without the federation; `run.keys` has those on record."""
        return self._table(key)

    @property
    def events(self) -> "pandas.DataFrame":
        """What happened, by kind, source, subject and text."""
        return self._table(keys.EVENT)

    def estimate_errors(self, drone: str) -> "pandas.DataFrame":
        """Return estimate − truth of a drone: x_m, y_m, z_m in W, yaw_rad, the stated σ of each, and NEES."""
        errors = self._estimate_errors
        if drone not in errors:
            raise RunError(_unknown("drone with truth and estimates", drone, list(errors), self.record))
        of = errors[drone]
        names = ("x_m", "y_m", "z_m", "yaw_rad")
        columns = {name: of.error[:, i] for i, name in enumerate(names)}
        columns |= {f"{name}_sigma": of.sigma[:, i] for i, name in enumerate(names)}
        return _frame({"t_s": of.t_s, **columns, "nees": of.nees})

    def errors(self, window: tuple[float, float] | None = None) -> "pandas.DataFrame":
        """Return the errors of every variable of every formation, with its unit; the report's table.

        `est_…` is estimate − desired, what the controller saw; `true_…` truth − desired, what the drones did; over
        the instants of the window at which the formation was engaged, NaN without any.

        Args:
            window: from and to [s]; None: the report's, `run.summary.window_s`.
        """
        window_s = window or self.summary.window_s
        rows: list[dict[str, Any]] = []
        for formation in self._formations:
            for variable, of in formation.errors(window_s).items():
                moments = {name: getattr(of, name) for name in ParameterErrors.__struct_fields__}
                numbers = {name: np.nan if value is None else value for name, value in moments.items()}
                rows.append({"cluster": formation.name, "variable": variable, "unit": unit(variable), **numbers})
        columns = {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}
        return _frame(columns, ["cluster", "variable"])

    def xarray(self) -> "xarray.Dataset":
        """Return truth and estimates of all drones, with the dimensions t_s and drone; needs xarray and pandas."""
        import xarray

        parts: list[Any] = []
        for what, read in (("truth", self.truth), ("estimate", self.estimate)):
            drones = [d for d in self.drones if f"drone/{d}/{what}" in self.keys]
            tables = [read(drone).select_dtypes("number").add_prefix(f"{what}_").to_xarray() for drone in drones]
            if tables:
                parts.append(xarray.concat(tables, xarray.DataArray(drones, dims="drone", name="drone"), join="outer"))
        merged: Any = xarray.merge(parts, join="outer", compat="no_conflicts")
        return merged

    # What the report says

    @property
    def summary(self) -> "RunSummary":
        """The content of summary.json."""
        return self._judged[2]

    @property
    def drones(self) -> list[str]:
        """Names of the drones on record."""
        info = self._flight.info
        return [drone.name for drone in info.drones] if info else [track.name for track in self._flight.tracks]

    @property
    def scenario(self) -> Any:
        """The resolved scenario; None if this version cannot read it."""
        return self._flight.scenario

    @property
    def as_planned(self) -> bool:
        """Whether the flight followed its plan; `shortfalls` has the deviations."""
        return self.summary.as_planned

    @property
    def shortfalls(self) -> list[Shortfall]:
        return self.summary.shortfalls

    @property
    def truth_sha256(self) -> str:
        """The hash of all truth: equal for flights that are equal to the bit."""
        return self.summary.truth_sha256

    @property
    def duration_s(self) -> float:
        """Simulated time that was flown [s]."""
        return self.summary.sim_s

    def figure(self, name: str) -> "Figure":
        """Return a figure of the report: "errors", "position", "orientation", "shape", "plan_view", "distances",
        "drones", "estimates", "velocities"; of further clusters with the cluster's name, "shape_CLUSTER".

        Raises:
            RunError: the record has no such figure.
        """
        from zsim_analysis.report.make_report import figures

        known = []
        for each in figures(*self._judged):
            known.append(_plain_name(each.name))
            if name in (known[-1], Path(each.name).stem):
                # a figure without pyplot is shown by a notebook only if it has this
                setattr(each.drawing, "_repr_png_", _png_of(each.drawing))  # noqa: B010
                return each.drawing
        raise RunError(_unknown("figure", name, known, self.record))

    def report(self, formats: Sequence[str] = ()) -> Path:
        """Write the report into the run's folder, as `zsim report` does; return its page.

        Args:
            formats: of figures beside PNG: "pdf", "svg".
        """
        from zsim_analysis.report.make_report import make_report

        make_report(self.folder, formats=formats)
        return self.folder / "report.html"

    def __repr__(self) -> str:
        return f"<Run {self.folder}>"

    def _repr_html_(self) -> str:
        summary = self.summary
        verdict = "as planned" if summary.as_planned else "NOT AS PLANNED"
        facts = {
            "Scenario": f"{summary.scenario}, seed {summary.seed}, {len(self.drones)} drones",
            "Flown": f"{summary.sim_s:g} s ({summary.ended}), {verdict}",
            **{f"Note {i}" if i else "Note": each.text for i, each in enumerate(summary.shortfalls[:3])},
            "Record": f"{self.folder} ({summary.record.state})",
        }
        rows = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(str(v))}</td></tr>" for k, v in facts.items())
        errors = self.errors()
        return f"<table>{rows}</table>" + (errors._repr_html_() if hasattr(errors, "_repr_html_") else "")  # type: ignore[operator]

    # Reading

    @cached_property
    def _judged(self) -> tuple[RecordedFlight, list[Formation], "RunSummary"]:
        from zsim_analysis.report.make_report import judge

        return judge(self.record, answers=True)

    @property
    def _flight(self) -> RecordedFlight:
        return self._judged[0]

    @property
    def _formations(self) -> list[Formation]:
        return self._judged[1]

    @cached_property
    def _estimate_errors(self) -> dict[str, EstimateErrors]:
        return estimate_errors(self._flight)

    def _of_drone(self, drone: str, what: str, group: str = "") -> "pandas.DataFrame":
        key = f"drone/{drone}/{what}"
        if key not in self.keys:
            drones = list(dict.fromkeys(keys.thing(each) for each in self.keys if each.startswith("drone/")))
            if drone not in drones:
                raise RunError(_unknown("drone", drone, drones, self.record))
            parts = [keys.parts(each)[2] for each in self.keys if each.startswith(f"drone/{drone}/")]
            own = [each.removeprefix(f"{group}/") for each in parts if each.startswith(f"{group}/") or not group]
            raise RunError(
                _unknown(f"{group or 'message'} of {drone}", what.removeprefix(f"{group}/"), own, self.record)
            )
        return self._table(key)

    def _table(self, key: str) -> Any:
        if key not in self.keys:
            raise RunError(_unknown("key", key, self.keys, self.record))
        if key not in self._tables:
            self._tables[key] = read_table(self.record, key)
        table = self._tables[key]
        return table.copy() if hasattr(table, "copy") else dict(table)


def read_table(record: Path, key: str) -> Any:
    """Return the messages of one key of a record as a table."""
    parts: dict[str, list[Any]] = {}
    with RecordReader(record) as reader:
        selection = MessageSelection((key,))
        survey = TableSurvey(reader, selection)
        decoded = DecodedMessages(selection.messages(reader, survey.wanted), survey.decode, lambda _: None)
        for batch in batches(decoded, survey.width):
            for each in survey.table(batch.kind):
                values = each.values(batch)
                split = values.T if isinstance(values, np.ndarray) and values.ndim == 2 else [values]
                for column, of_column in zip(each.columns, split, strict=True):
                    parts.setdefault(column, []).append(_array(of_column, each.kind))
    columns = {name: np.concatenate(arrays) for name, arrays in parts.items() if name not in DROPPED}
    return _frame(columns)


def _array(values: Sequence[Any] | NDArray[Any], kind: str) -> NDArray[Any]:
    if kind == "text" or any(value is None for value in values):
        return np.array(values, object) if kind in ("text", "flag") else np.array(values, np.float64)
    return np.asarray(values, {"whole": np.int64, "number": np.float64, "flag": bool}[kind])


def _frame(columns: Mapping[str, NDArray[Any]], index: Sequence[str] = ("t_s",)) -> Any:
    """Return columns as a pandas frame; as they are without pandas."""
    try:
        import pandas
    except ModuleNotFoundError:
        return dict(columns)
    table = pandas.DataFrame(dict(columns))
    return table.set_index(list(index) if len(index) > 1 else index[0]) if set(index) <= set(columns) else table


def _plain_name(file: str) -> str:
    """Return the name of a figure without the paper's number and the suffix: shape for figure_8_shape.png."""
    stem = Path(file).stem
    return stem.split("_", 2)[2] if stem.startswith("figure_") else stem


def _png_of(drawing: "Figure") -> Callable[[], bytes]:
    def png() -> bytes:
        from io import BytesIO

        file = BytesIO()
        drawing.savefig(file, format="png")
        return file.getvalue()

    return png


def _unknown(what: str, found: str, known: Sequence[str], record: Path) -> str:
    listed = ", ".join(known) or "it has none"
    return f"{record}: no {what} is {found!r}; {suggestion(found, known)}there are {listed}"
