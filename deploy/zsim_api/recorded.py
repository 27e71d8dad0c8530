"""A recorded run, read from Python.

    run = zsim.load("runs/step")
    run.truth("drone1").position_m_z.plot()
    run.errors(window=(20, 40))
    run.figure("shape")

Each key is read once, on first use, and cached. Records of runs in one process or as processes on any hosts, of
interrupted runs and of replays are all treated the same.
"""

import html
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.contract import keys
from zsim.contract.messages import REFUSALS, Info
from zsim.contract.run_messages import Event
from zsim.errors import RecordError, RunError, what_is_missing
from zsim.output_folder import RECORD, record_at
from zsim.record import RecordReader
from zsim.schema import plugin, yaml_file
from zsim.schema.checker import suggestion
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.export.columns import (
    DecodedMessages,
    Kind,
    MessageSelection,
    TableSurvey,
    as_array,
    batches,
    column_values,
    component_names,
    json_text,
    subject,
)
from zsim_analysis.reading.drone_errors import EstimateErrors, estimate_errors
from zsim_analysis.reading.formation import Formation, ParameterErrors, cluster_of
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.reading.recorded_run import decode_or_none
from zsim_analysis.reading.shortfall import Shortfall
from zsim_analysis.report.summary import RunSummary, error_table, judge
from zsim_api.scenarios import Scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame
    from xarray import Dataset

Table = dict[str, NDArray[Any]]  # columns of equal length (K,), ordered by simulated time
INDEX = "t_s"
STAMPS = ("t_ns", "seq", "wall_ns")  # metadata columns of a message
SHOWN = 12  # maximum number of names listed in an error
ROWS_MAX = 200_000  # maximum number of rows read at once for several drones; that many estimates take 100 MB
NOTES = 3  # maximum number of shortfalls shown when a notebook displays a run
ERROR_COLUMNS = ("position_m_x", "position_m_y", "position_m_z", "yaw_rad")  # named as in tables of estimates
Window = tuple[float, float]


def load(place: str | Path, trust: bool = False) -> "Run":
    """Open a recorded run of any kind: in one process, as processes, on several hosts, or interrupted.

    Args:
        place: the folder of a run, or its `run.mcap`.
        trust: whether the scenario's own cluster spaces may be imported, which runs code that came with the record.
            Without it, clusters with such a space have no errors; everything else can be read.

    Raises:
        RunError: there is no record.
        RecordError: the file is not a record of zsim.
    """
    return Run(place, trust)


class Run:
    """A recorded run.

    Tables are pandas frames with simulated time in seconds as index, `t_s`, and units in the names of their columns,
    which are those of `zsim export`; docs/records.md lists them. Without pandas they are dicts of numpy arrays by
    column. Bit-identical runs have equal tables, except for `source`, which names processes.

    Attributes:
        record: path of the file.
        keys: number of recorded messages by key.
        drones, clusters: names, in the order of the scenario.
    """

    def __init__(self, place: str | Path, trust: bool = False) -> None:
        self.record = record_at(Path(place))
        self._trust = trust
        self._tables: dict[str, Table] = {}
        with RecordReader(self.record) as reader:
            self.keys = reader.topics()
            recorded = reader.last(keys.INFO)
        self._info: Info | None = decode_or_none(recorded) if recorded else None
        drones = [drone.name for drone in self._info.drones] if self._info else self._named("drone")
        clusters = [cluster.name for cluster in self._info.clusters] if self._info else self._named("cluster")
        self.drones, self.clusters = tuple(drones), tuple(clusters)

    @property
    def folder(self) -> Path:
        """The folder of the record."""
        return self.record.parent

    # Tables

    def truth(self, drone: str) -> "DataFrame":
        """Return the true motion of a drone at every gate, in W and B; raise RunError if there is none."""
        return self._read_leaf("drone", drone, "truth")

    def estimate(self, drone: str) -> "DataFrame":
        """Return the estimates of a drone's motion, with their covariance; raise RunError if there are none."""
        return self._read_leaf("drone", drone, "estimate")

    def sensor(self, drone: str, sensor: str) -> "DataFrame":
        """Return the samples of imu, gps, mag, baro, sonar, flow, or your own sensor; raise RunError if there are none.

        `t_sample_ns` is the time at which a sample was taken; the index is the time of its delivery.
        """
        return self._read_leaf("drone", drone, f"sensor/{sensor}")

    def status(self, drone: str) -> "DataFrame":
        """Return the state of a drone's firmware and battery at every gate; raise RunError if there is none."""
        return self._read_leaf("drone", drone, "sensor/status")

    def commands(self, drone: str, kind: str = "velocity") -> "DataFrame":
        """Return all commands sent to a drone, with their `source`; raise RunError if there are none.

        Args:
            drone: name.
            kind: velocity, attitude, rotors, ardrone or mode.
        """
        return self._read_leaf("drone", drone, f"cmd/{kind}")

    def cluster(self, cluster: str | None = None) -> "DataFrame":
        """Return the states of a cluster as its controller saw it: `phase`, `value_p`, `desired_p` and so on [m, rad].

        Args:
            cluster: name; None: the first.

        Raises:
            RunError: no such cluster, or its controller published nothing.
        """
        return self._read_leaf("cluster", self._cluster(cluster), "state")

    def messages(self, key: str) -> "DataFrame":
        """Return all messages of a key, with `t_ns`, `seq` and `wall_ns`, the time of recording [ns since 1970].

        Messages of a program of your own have a column for each field.

        Args:
            key: without the federation's name and without wildcards; `run.keys` lists the recorded keys.

        Raises:
            RunError: the record has no message of this key.
        """
        return frame(self._table(key))

    @property
    def events(self) -> "DataFrame":
        """The events, with kind, source, subject, text, and data as JSON text; raises RunError if there are none."""
        return self._plain(keys.EVENT)

    # Errors

    def formation(self, cluster: str | None = None) -> "DataFrame":
        """Return the variables of a formation over time, its `phase`, and its errors (angles within ±π).

        For a variable p: `desired_p_m`, `estimate_p_m`, `truth_p_m`; `estimate_error_p_m` is estimate − desired, as the
        controller saw it; `truth_error_p_m` is truth − desired. NaN where unknown. Until the phase is engaged, the
        desired value is the estimate.

        Args:
            cluster: name; None: the first.

        Raises:
            RunError: no such cluster, or its states cannot be judged.
        """
        states = self.judged_formation(cluster)
        parts = {
            "desired": states.desired,
            "estimate": states.value,
            "truth": states.true,
            "estimate_error": states.est_error,
            "truth_error": states.true_error,
        }
        table: Table = {INDEX: states.t_s, "phase": np.array(states.phases, object)}
        for i, name in enumerate(states.names):
            table |= {f"{kind}_{name}_{unit(name)}": values[:, i] for kind, values in parts.items()}
        return frame(table)

    def estimate_errors(self, drone: str) -> "DataFrame":
        """Return estimate − truth of a drone over time: position in W and heading, the σ of each as stated by the
        estimator (`sigma_position_m_x`), and `nees`, which is 6 on average for a consistent estimator.

        If all drones together have 200 000 estimates or more, only those at every n-th gate are compared.

        Raises:
            RunError: no such drone, or the record lacks its truth or its estimates.
        """
        own = self._drone_errors.get(self._known("drone", drone, self.drones))
        if own is None:
            raise RunError(f"{self.record}: does not contain both truth and estimates of {drone}")
        errors = dict(zip(ERROR_COLUMNS, own.error.T, strict=True))
        sigmas = {f"sigma_{name}": values for name, values in zip(ERROR_COLUMNS, own.sigma.T, strict=True)}
        return frame({INDEX: own.t_s, **errors, **sigmas, "nees": own.nees})

    def errors(
        self, window: Window | None = None, of: Literal["formations", "estimates"] = "formations"
    ) -> "DataFrame":
        """Return error statistics as in the report's tables, with a row for each variable and its unit.

        For formations, by cluster and variable, over the part of the window in which the cluster was engaged: `est_…`
        is estimate − desired, as the controller saw it, `true_…` is truth − desired. For estimates, by drone and
        variable: `std`, `rms` and `mean` of estimate − truth, and `inside`, the share of errors within two stated
        standard deviations. NaN where the window has no such samples.

        Args:
            window: start and end [s]; None: the report's, `run.summary.window_s`.
            of: "formations" or "estimates".

        Raises:
            RunError: the window's end is not after its start, or `of` is unknown.
            RecordError: the record contains no truth.
        """
        window = self.summary.window_s if window is None else _checked(window)
        if of == "estimates":
            return _statistics("drone", {name: _moments(each, window) for name, each in self._drone_errors.items()})
        if of != "formations":
            raise RunError(f"of is {of!r}; must be 'formations' or 'estimates'")
        rows = {
            each.name: {
                name: (unit(name), *(getattr(moments, field) for field in ParameterErrors.__struct_fields__))
                for name, moments in each.errors(window).items()
            }
            for each in self._assessment[1]
        }
        return _statistics("cluster", rows, ParameterErrors.__struct_fields__)

    def xarray(self) -> "Dataset":
        """Return truth and estimates of all drones, with the dimensions drone and t_s; needs xarray and pandas."""
        with what_is_missing():
            import pandas
            import xarray

        parts: list[Dataset] = []
        for kind, read in (("truth", self.truth), ("estimate", self.estimate)):
            recorded_drones = [drone for drone in self.drones if f"drone/{drone}/{kind}" in self.keys]
            if recorded_drones:
                self._read([key for drone in recorded_drones if (key := f"drone/{drone}/{kind}") not in self._tables])
                tables = {
                    drone: read(drone).select_dtypes("number").add_prefix(f"{kind}_") for drone in recorded_drones
                }
                # a restarted world may have published a gate again
                once = {drone: table[~table.index.duplicated()] for drone, table in tables.items()}
                parts.append(pandas.concat(once, names=["drone"]).to_xarray().reindex(drone=recorded_drones))
        return xarray.merge(parts, join="outer", compat="no_conflicts")

    # The flight

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario with all defaults and overrides; it can be flown again.

        Raises RunError if the record does not contain `world/info`.
        """
        if self._info is None:
            raise RunError(f"{self.record}: has no world/info, so its scenario is unknown")
        scenario = Scenario(**yaml_file.value(self._info.scenario))
        modules = () if self._info.module_folders is UNSET else self._info.module_folders
        scenario.source = str(self.record)
        scenario.folders = (*(self.folder / each for each in modules), self.folder, Path.cwd())
        return scenario

    @property
    def summary(self) -> RunSummary:
        """The content of summary.json; raises RecordError if the record contains no truth."""
        return self._assessment[2]

    @property
    def duration_s(self) -> float:
        """Simulated duration of the flight [s]."""
        sim_s = self._end.get("sim_s")
        return self.summary.sim_s if sim_s is None else float(sim_s)

    @property
    def ended(self) -> str:
        """Why the run ended."""
        return str(self._end["reason"]) if "reason" in self._end else self.summary.ended

    @property
    def truth_sha256(self) -> str:
        """The SHA-256 of all truth messages: equal for bit-identical flights."""
        return str(self._end.get("truth_sha256") or self.summary.truth_sha256)

    @property
    def complete(self) -> bool:
        """Whether all messages of the world and the run's end were recorded; `summary.record.state` names any gaps."""
        try:
            return self.summary.record.complete
        except RecordError:  # the record contains no truth
            return False

    @property
    def as_planned(self) -> bool:
        """Whether the flight followed its plan; `shortfalls` lists the deviations."""
        return self.summary.as_planned

    @property
    def shortfalls(self) -> list[Shortfall]:
        """The deviations of the flight from its plan, as in the report."""
        return self.summary.shortfalls

    # Display

    def figure(self, name: str) -> "Figure":
        """Draw a figure of the report.

        Args:
            name: errors, position, orientation, shape, plan_view, distances, references, radio, drones, estimates
                or velocities; for clusters after the first, with the cluster's name: `shape_side`.

        Raises:
            RunError: the record has no such figure.
        """
        with what_is_missing():
            from zsim_analysis.report.make_report import draw_marked, planned_figures

        flight, formations, summary = self._assessment
        names = []
        with plugin.names_only(not self._trust, looked_up=False):
            for each in planned_figures(flight, formations, summary.window_s):
                stem = Path(each.name).stem
                names.append(stem.split("_", 2)[2] if stem.startswith("figure_") else stem)  # figure_8_shape
                if name in (names[-1], stem):
                    drawing = draw_marked(each, summary).drawing
                    # without pyplot, a notebook displays a figure only if it has this method
                    setattr(drawing, "_repr_png_", _png_of(drawing))  # noqa: B010
                    return drawing
        raise RunError(f"{self.record}: has no figure {name!r}; {_choices(name, names)}")

    def report(self, formats: Sequence[str] = ()) -> Path:
        """Write the report into the run's folder, as `zsim report` does; return the path of its page.

        Args:
            formats: further formats of the figures: "pdf", "svg".

        Raises:
            RunError: the record is not in the folder of a run.
            ReportError: the folder cannot be written.
        """
        with what_is_missing():
            from zsim_analysis.report.make_report import make_report

        if self.record.name != RECORD:
            raise RunError(f"{self.record}: has no folder for its report; must be {RECORD} in the folder of a run")
        with plugin.names_only(not self._trust, looked_up=False):
            make_report(self.folder, formats=formats)
        return self.folder / "report.html"

    def __repr__(self) -> str:
        return f"<Run {self.record}, {len(self.drones)} drones>"

    def _repr_html_(self) -> str:
        try:
            summary = self.summary
        except RecordError as error:  # nothing was flown
            return f"<p>{html.escape(str(error))}</p>"
        facts = {
            "Scenario": f"{summary.scenario}, seed {summary.seed}, {len(self.drones)} drones",
            "Flown": f"{summary.sim_s:g} s, {'as planned' if summary.as_planned else 'not as planned'}",
            "Ended": summary.ended,
            **{f"Note {i}": each.text for i, each in enumerate(summary.shortfalls[:NOTES], start=1)},
            "Record": f"{self.record}: {summary.record.state}",
        }
        parts = [_html_table([], [[f"<b>{label}</b>", html.escape(text)] for label, text in facts.items()])]
        for name, cluster in summary.clusters.items():
            table = error_table(cluster)
            cells = [[html.escape(cell) for cell in row] for row in table.rows]
            parts += [f"<p>Errors of {html.escape(name)}</p>", _html_table(table.columns, cells)]
        return "".join(parts)

    # Reading

    @cached_property
    def _assessment(self) -> tuple[RecordedFlight, list[Formation], RunSummary]:
        with plugin.names_only(not self._trust, looked_up=False):
            return judge(self.record, answers=True)

    @cached_property
    def _drone_errors(self) -> dict[str, EstimateErrors]:
        return estimate_errors(self._assessment[0])

    @cached_property
    def _end(self) -> Mapping[str, Any]:
        """Data of the world's last `end` event; empty without one."""
        with RecordReader(self.record) as reader:
            events = [decode_or_none(recorded) for recorded in reader.messages({keys.EVENT}, by_time=False)]
        return next((e.data for e in reversed(events) if isinstance(e, Event) and e.kind == "end"), {})

    def _table(self, key: str) -> Table:
        if key not in self.keys:
            raise RunError(f"{self.record}: has no messages of {key!r}; {_choices(key, self.keys)}")
        if key not in self._tables:
            fleet = self._of_all_drones(key)
            missing = [each for each in fleet if each not in self._tables]
            # a user who reads a second drone usually reads all, and one more pass takes longer than decoding a key
            is_second = len(fleet) - len(missing) > 0
            at_once = is_second and sum(self.keys[each] for each in missing) <= ROWS_MAX
            self._read(missing if at_once else [key])
        return self._tables[key]

    def _of_all_drones(self, key: str) -> list[str]:
        """Return the recorded keys of all drones that correspond to a drone's key; for another key, that key alone."""
        kind, _, leaf = keys.parts(key)
        corresponding = [f"drone/{drone}/{leaf}" for drone in self.drones] if kind == "drone" else [key]
        return [each for each in corresponding if each in self.keys]

    def _read(self, requested_keys: Sequence[str]) -> None:
        """Read the tables of the `requested_keys` in one pass over the record."""
        if not requested_keys:
            return
        with plugin.names_only(not self._trust, looked_up=False):
            tables = read_tables(self.record, requested_keys)
        for table in tables.values():
            for values in table.values():
                values.setflags(write=False)  # frames copy them, dicts share them
        self._tables |= tables

    def _plain(self, key: str) -> "DataFrame":
        """Return the messages of a key without their stamps."""
        return frame({column: values for column, values in self._table(key).items() if column not in STAMPS})

    def _read_leaf(self, kind: str, name: str, leaf: str) -> "DataFrame":
        key = f"{kind}/{self._known(kind, name, self.drones if kind == 'drone' else self.clusters)}/{leaf}"
        if key not in self.keys:
            group, _, last = leaf.rpartition("/")  # "sensor", "gps"
            prefix = f"{kind}/{name}/{group}/" if group else f"{kind}/{name}/"
            available = [each.removeprefix(prefix) for each in self.keys if each.startswith(prefix)]
            missing = f"{group} {last!r}" if group else leaf
            raise RunError(f"{self.record}: has no {missing} of {name}; {_choices(last, available)}")
        return self._plain(key)

    def _known(self, kind: str, name: str, names: Sequence[str]) -> str:
        if name not in names:
            raise RunError(f"{self.record}: has no {kind} {name!r}; {_choices(name, names)}")
        return name

    def _named(self, kind: str) -> list[str]:
        """Return the drones or clusters with recorded messages."""
        return list(dict.fromkeys(keys.thing(key) for key in self.keys if key.startswith(f"{kind}/")))

    def _cluster(self, name: str | None) -> str:
        if name is None and not self.clusters:
            raise RunError(f"{self.record}: has no cluster")
        return self._known("cluster", self.clusters[0] if name is None else name, self.clusters)

    def _untrusted(self, cluster: str) -> str:
        """Return the end of an error about a cluster whose space was not imported, naming it; empty otherwise."""
        scenario = None if self._trust else self._assessment[0].scenario
        own = cluster_of(scenario, cluster)
        names = [each.space for each in (own, *own.groups) if each.space and ":" in each.space] if own else []
        return f"; its space {names[0]} is imported only by zsim.load(…, trust=True)" if names else ""

    def judged_formation(self, cluster: str | None = None) -> Formation:
        """Return the content of `formation` as arrays; raise the same errors."""
        name = self._cluster(cluster)
        formation = next((each for each in self._assessment[1] if each.name == name), None)
        if formation is None:
            raise RunError(f"{self.record}: has no states of cluster {name} that can be judged{self._untrusted(name)}")
        return formation


def _checked(window: Window) -> Window:
    try:
        start_s, end_s = map(float, window)
        if start_s < end_s:
            return start_s, end_s
    except (TypeError, ValueError):
        pass
    raise RunError(f"window is {window!r}; must be start and end [s], such as (20, 40)")


def _moments(errors: EstimateErrors, window: Window) -> dict[str, tuple[Any, ...]]:
    """Return unit, standard deviation, RMS, mean and share within two stated σ of each error in a window."""
    rows = (errors.t_s >= window[0]) & (errors.t_s <= window[1])
    inside = errors.share_inside(rows) if rows.any() else [None] * len(ERROR_COLUMNS)
    moments = {}
    units = ("m", "m", "m", "rad", "")
    columns = np.column_stack([errors.error, errors.nees])[rows].T
    for name, measure, values, share in zip((*ERROR_COLUMNS, "nees"), units, columns, (*inside, None), strict=True):
        finite = values[np.isfinite(values)]
        statistics = (finite.std(), np.sqrt(np.mean(finite**2)), finite.mean()) if len(finite) else (None,) * 3
        moments[name] = (measure, *statistics, share)
    return moments


def _statistics(
    index_name: str,
    rows: Mapping[str, Mapping[str, tuple[Any, ...]]],
    fields: Sequence[str] = ("std", "rms", "mean", "inside"),
) -> "DataFrame":
    """Return a frame with a row for each variable of each cluster or drone: its unit, and numbers or NaN."""
    flat = [(name, variable, *values) for name, variables in rows.items() for variable, values in variables.items()]
    names = (index_name, "variable", "unit", *fields)
    texts = 3
    return frame(
        {name: np.array([row[i] for row in flat], object if i < texts else np.float64) for i, name in enumerate(names)},
        (index_name, "variable"),
    )


def _choices(name: str, names: Iterable[str]) -> str:
    """Return a suggestion of the most similar name, and the available names."""
    names = list(names)
    omitted = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f"{suggestion(name, names)}there are {', '.join(names[:SHOWN])}{omitted}" if names else "there are none"


def _png_of(drawing: "Figure") -> Callable[[], bytes]:
    def png() -> bytes:
        file = BytesIO()
        drawing.savefig(file, format="png")
        return file.getvalue()

    return png


def _html_table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    header = "".join(f"<th>{html.escape(each)}</th>" for each in titles)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table>{f'<tr>{header}</tr>' if header else ''}{body}</table>"


# Messages as tables


def read_tables(record: Path, requested_keys: Collection[str]) -> dict[str, Table]:
    """Return all messages of the `requested_keys`, by key, in one pass over the record.

    Columns are those of the export, without `name`, which is the same in all rows. Messages of a key outside the
    contract, and pictures, have a column for each field, or for each element of a field that is a list of numbers.

    Args:
        record: path of the file.
        requested_keys: one key, or the same key of several drones.
    """
    with RecordReader(record) as reader:
        selection = MessageSelection(tuple(requested_keys))
        survey = TableSurvey(reader, selection)
        by_subject = {subject(key): key for key in requested_keys}
        parts: dict[str, dict[str, list[NDArray[Any]]]] = {key: {} for key in requested_keys if key in survey.kinds}
        decoded = DecodedMessages(selection.messages(reader, [*parts]), survey.decode, lambda _: None)
        for batch in batches(decoded, survey.width, by_name=True):
            for name, kind, values in column_values(survey.table(batch.kind)[1:], batch):
                parts[by_subject[batch.only]].setdefault(name, []).append(as_array(kind, values))
        own = {key: _own_table(reader, key) for key in requested_keys if key not in parts}
    tables = {key: {name: np.concatenate(each) for name, each in columns.items()} for key, columns in parts.items()}
    return {**tables, **own}


def frame(table: Mapping[str, NDArray[Any]], index: Sequence[str] = (INDEX,)) -> "DataFrame":
    """Return a table as a pandas DataFrame with one or more columns as its index; without pandas, a dict of arrays."""
    try:
        from pandas import DataFrame
    except ModuleNotFoundError:
        return {**{name: table[name] for name in index}, **table}  # type: ignore[return-value]
    return DataFrame(dict(table)).set_index(list(index) if len(index) > 1 else index[0])


def _own_table(reader: RecordReader, key: str) -> Table:
    t_ns, wall_ns, contents = [], [], []
    for recorded in reader.messages({key}):
        try:
            content = msgspec.msgpack.decode(recorded.payload)
        except REFUSALS:
            content = {"hexadecimal": recorded.payload.hex()}
        is_map = isinstance(content, dict) and all(isinstance(name, str) for name in content)
        contents.append(content if is_map else {"content": content})
        t_ns.append(recorded.t_ns)
        wall_ns.append(recorded.wall_ns)
    stamps = np.array(t_ns, np.uint64)
    table: Table = {INDEX: stamps / 1e9, "t_ns": stamps.astype(np.int64)}
    for name in dict.fromkeys(name for content in contents for name in content if name != "t_ns"):
        table |= _own_columns(
            f"content_{name}" if name in (INDEX, "wall_ns") else name, [content.get(name) for content in contents]
        )
    return {**table, "wall_ns": np.array(wall_ns, np.uint64).astype(np.int64)}


def _own_columns(name: str, values: Sequence[Any]) -> Table:
    present = [value for value in values if value is not None]
    width = len(present[0]) if present and isinstance(present[0], list) else 0
    vectors = (isinstance(each, list) and len(each) == width and _kind(each) in ("whole", "number") for each in present)
    if width and all(vectors):
        rows = np.array([value or [np.nan] * width for value in values], np.float64)
        return dict(zip(component_names(name, width), rows.T, strict=True))
    kind = _kind(present)
    if kind == "text":
        values = [value if isinstance(value, str | bytes | None) else json_text(value) for value in values]
    elif kind == "flag" and len(present) < len(values):
        return {name: np.array(values, object)}
    return {name: as_array(kind, list(values))}


def _kind(values: Sequence[Any]) -> Kind:
    """Return the kind of column that can hold all of these values; a text column holds anything."""
    if values and all(isinstance(value, bool) for value in values):
        return "flag"
    if values and all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        is_int64 = all(isinstance(value, int) and abs(value) < 2**63 for value in values)
        return "whole" if is_int64 else "number"
    return "text"
