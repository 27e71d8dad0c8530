"""A run on record, read from Python.

    run = zsim.load("runs/step")
    run.truth("drone1")["position_m_z"].plot()
    run.error_summary("main", window=(20, 40))
    run.figure("shape")

It reads what it is asked for when it is asked for it, each key once, and keeps that. Records of runs in one process, of
processes on any hosts, of runs that were cut, and of replays are the same to it.
"""

from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import UNSET

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.errors import RecordError
from zsim.output_folder import record_at
from zsim.record import RecordReader
from zsim.schema import plugin, yaml_file
from zsim.schema.checker import suggestion
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.drone_errors import EstimateErrors, estimate_errors
from zsim_analysis.reading.formation import Formation, ParameterErrors
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.reading.recorded_run import decode_or_none
from zsim_analysis.report.summary import RunSummary, judge
from zsim_api.scenarios import Scenario
from zsim_api.tables import INDEX, STAMPS, Table, frame, read_table

if TYPE_CHECKING:
    from pandas import DataFrame

SHOWN = 12  # names in an error
ERROR_COLUMNS = ("position_m_x", "position_m_y", "position_m_z", "yaw_rad")  # as those of estimates
Window = tuple[float, float]


def load(place: str | Path, trust: bool = False) -> "Run":
    """Return the run of a folder, or of a record in a file; see `Run`.

    Args:
        place: folder of a run, or its `run.mcap`.
        trust: whether classes of the scenario's own may be imported where they are needed, which runs code that came
            with the record. Only clusters with a space of their own need it; everything else is read without.

    Raises:
        RunError: there is no record.
        RecordError: it is none of zsim's, or cannot be read.
    """
    return Run(place, trust)


class Run:
    """A run on record. Frames have simulated time `t_s` [s] as index and units in the names of their columns.

    The columns are those of `zsim export`; docs/records.md lists them. Without pandas a frame is a dict of numpy arrays
    by column, `t_s` first. Arguments as of `load`.

    Attributes:
        record: its file, `folder` that in which it is.
        keys: number of messages on record by key.
        drones, clusters: names, in the order of the scenario.
    """

    def __init__(self, place: str | Path, trust: bool = False) -> None:
        self.record = record_at(Path(place))
        self.trust = trust
        with RecordReader(self.record) as reader:
            self.keys = reader.topics()
            recorded = reader.last(keys.INFO)
            self.info: Info | None = decode_or_none(recorded) if recorded else None
        drones = self.info.drones if self.info else ()
        clusters = self.info.clusters if self.info else ()
        self.drones = tuple(drone.name for drone in drones) or self._things("drone")
        self.clusters = tuple(cluster.name for cluster in clusters) or self._things("cluster")
        self._tables: dict[str, Table] = {}

    @property
    def folder(self) -> Path:
        return self.record.parent

    # What was recorded

    def truth(self, drone: str) -> "DataFrame":
        """Return the true motion of a drone, W and B as in docs/conventions.md; RecordError if it is not on record."""
        return self._said_by("drone", drone, "truth")

    def estimate(self, drone: str) -> "DataFrame":
        """Return the estimates of a drone, with their covariance; RecordError if there are none."""
        return self._said_by("drone", drone, "estimate")

    def commands(self, drone: str, kind: str = "velocity") -> "DataFrame":
        """Return the commands that were sent to a drone, by anybody; `source` says by whom.

        Args:
            drone: name.
            kind: velocity, attitude, rotors, ardrone or mode.

        Raises:
            RecordError: no such drone, or no such commands.
        """
        return self._said_by("drone", drone, f"cmd/{kind}")

    def sensor(self, drone: str, name: str) -> "DataFrame":
        """Return the samples of a drone's sensor: `gps`, `status`, or one of your own; RecordError if there are none.

        `t_sample_ns` is when a sample was taken, the index when it was delivered.
        """
        return self._said_by("drone", drone, f"sensor/{name}")

    def cluster(self, name: str | None = None) -> "DataFrame":
        """Return the states of a cluster's controller: `phase`, `value_p`, `desired_p` and so on [m or rad].

        Args:
            name: None for the first cluster.

        Raises:
            RecordError: no such cluster, or it published nothing.
        """
        return self._said_by("cluster", self._first_cluster() if name is None else name, "state")

    def messages(self, key: str) -> "DataFrame":
        """Return all messages of a key, also one of your own; RecordError if there are none.

        With the columns `t_ns`, `seq` and `wall_ns`, when the recorder received a message [ns since 1970].
        Messages of your own have a column for each field.

        Args:
            key: without the federation's name and without wildcards: `drone/drone1/link`.
        """
        return frame(self._table(key))

    @property
    def events(self) -> "DataFrame":
        """What happened: kind, source, subject, text, and `data` as JSON text."""
        table = self._table(keys.EVENT)
        return frame({name: values for name, values in table.items() if name not in STAMPS})

    # How it was flown

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario with which it was flown, with all defaults; RecordError without `world/info` on record."""
        if self.info is None:
            raise RecordError(f"{self.record}: has no world/info, so that its scenario is unknown")
        made = Scenario(**yaml_file.value(self.info.scenario))
        modules = () if self.info.module_folders is UNSET else self.info.module_folders
        made.source, made.folders = str(self.record), (*map(Path, modules), self.folder, Path.cwd())
        made.changes = None if self.info.changed is UNSET else self.info.changed
        return made

    @cached_property
    def summary(self) -> RunSummary:
        """What `zsim report` writes into summary.json; RecordError if there is no truth on record."""
        return self._judged[2]

    @property
    def duration_s(self) -> float:
        """Simulated time that was flown [s]."""
        sim_s = self._end.get("sim_s")
        return self.summary.sim_s if sim_s is None else float(sim_s)

    @property
    def ended(self) -> str:
        """Why it ended."""
        return str(self._end["reason"]) if "reason" in self._end else self.summary.ended

    @property
    def complete(self) -> bool:
        """Whether every message of the world is on record, and the end; `summary.record.state` says what is missing."""
        return self.summary.record.complete

    @property
    def as_planned(self) -> bool:
        """Whether it followed its plan, as far as it went; `summary.shortfalls` has what differed."""
        return self.summary.as_planned

    @property
    def truth_sha256(self) -> str:
        """Hash of the true motion of all drones; runs with the same bits have the same one."""
        return str(self._end.get("truth_sha256") or self.summary.truth_sha256)

    def formation(self, name: str | None = None) -> Formation:
        """Return the flight of a cluster as arrays: desired, estimated and true variables, errors, phases.

        Raises:
            RecordError: no such cluster, or its states cannot be judged.
        """
        chosen = self._known("cluster", self._first_cluster() if name is None else name)
        found = next((each for each in self._judged[1] if each.name == chosen), None)
        if found is None:
            why = "; it may have a space of its own: load it with trust=True" if not self.trust else ""
            raise RecordError(f"{self.record}: has no states of {chosen} that can be judged{why}")
        return found

    def errors(self, of: str | None = None, window: Window | None = None) -> "DataFrame":
        """Return errors over time.

        Of a cluster, for each variable: `est_p_m`, what its controller saw (estimate − desired), and `true_p_m`, what
        the drones did (truth − desired), and whether it was `engaged`; until then, desired is the estimate. Of a drone,
        estimate − truth: `position_m_x`, …, `yaw_rad`, the standard deviations that the estimator states,
        `sigma_position_m_x`, …, and `nees`, 6 on average where these are true.

        Args:
            of: cluster or drone; None for the first cluster.
            window: first and last instant [s]; None for the whole run.

        Raises:
            RecordError: no such cluster or drone, or its errors are not known.
        """
        table = self._drone_table(of) if of in self.drones else self._cluster_table(self._judged_cluster(of))
        low, high = window or (-np.inf, np.inf)
        rows = (table[INDEX] >= low) & (table[INDEX] <= high)
        return frame({name: values[rows] for name, values in table.items()})

    def error_summary(self, of: str | None = None, window: Window | None = None) -> "DataFrame":
        """Return statistics of errors, a row for each variable, with its `unit`.

        Of a cluster as in the report, over the instants of the window at which it was engaged: `est_std`, `est_rms`,
        `est_mean`, `true_std`, `true_rms`, `true_mean`. Of a drone `std`, `rms`, `mean` of estimate − truth, and
        `inside`, the share of errors within two stated standard deviations.

        Args:
            of: cluster or drone; None for the first cluster.
            window: first and last instant [s]; None for that of the report.

        Raises:
            RecordError: as of `errors`.
        """
        window = window or self.summary.window_s
        if of not in self.drones:
            return _formation_statistics(self._judged_cluster(of), window)
        return _estimate_statistics(self._estimate_errors(of), window)

    def __repr__(self) -> str:
        return f"<Run of {self.record}, {len(self.drones)} drones, {sum(self.keys.values())} messages>"

    # Reading

    @cached_property
    def _judged(self) -> tuple[RecordedFlight, list[Formation], RunSummary]:
        with plugin.names_only(not self.trust):
            return judge(self.record, answers=True)

    @cached_property
    def _end(self) -> Mapping[str, Any]:
        """Data of the world's last `end` event; empty without one."""
        with RecordReader(self.record) as reader:
            events = [decode_or_none(recorded) for recorded in reader.messages({keys.EVENT}, by_time=False)]
        return next((e.data for e in reversed(events) if isinstance(e, Event) and e.kind == "end"), {})

    def _table(self, key: str) -> Table:
        if key not in self.keys:
            raise RecordError(f"{self.record}: has no messages of {key!r}; {_there(key, self.keys)}")
        if key not in self._tables:
            with plugin.names_only(not self.trust):
                table = read_table(self.record, key)
            for values in table.values():
                values.setflags(write=False)  # frames copy, and dicts share them
            self._tables[key] = table
        return self._tables[key]

    def _said_by(self, kind: str, name: str, what: str) -> "DataFrame":
        """Return the messages of a drone or cluster on one of its keys, without their stamps."""
        key = f"{kind}/{self._known(kind, name)}/{what}"
        if key not in self.keys:
            group, _, last = what.rpartition("/")  # "sensor", "gps"
            head = f"{kind}/{name}/{group}/" if group else f"{kind}/{name}/"
            there = [each.removeprefix(head) for each in self.keys if each.startswith(head)]
            raise RecordError(f"{self.record}: has no {what.replace('/', ' ')} of {name}; {_there(last, there)}")
        return frame({column: values for column, values in self._table(key).items() if column not in STAMPS})

    def _known(self, kind: str, name: str) -> str:
        names = self.drones if kind == "drone" else self.clusters
        if name not in names:
            raise RecordError(f"{self.record}: has no {kind} {name!r}; {_there(name, names)}")
        return name

    def _things(self, kind: str) -> tuple[str, ...]:
        return tuple(dict.fromkeys(keys.thing(key) for key in self.keys if key.startswith(f"{kind}/")))

    def _first_cluster(self) -> str:
        if not self.clusters:
            raise RecordError(f"{self.record}: has no cluster; name a drone: {', '.join(self.drones[:SHOWN])}")
        return self.clusters[0]

    def _judged_cluster(self, of: str | None) -> Formation:
        if of is not None and of not in self.clusters:
            names = (*self.clusters, *self.drones)
            raise RecordError(f"{self.record}: has no cluster or drone {of!r}; {_there(of, names)}")
        return self.formation(of)

    def _cluster_table(self, formation: Formation) -> Table:
        table: Table = {INDEX: formation.t_s}
        for i, name in enumerate(formation.names):
            table[f"est_{name}_{unit(name)}"] = formation.est_error[:, i]
            table[f"true_{name}_{unit(name)}"] = formation.true_error[:, i]
        return {**table, "engaged": formation.engaged}

    def _drone_table(self, drone: str) -> Table:
        own = self._estimate_errors(drone)
        errors = dict(zip(ERROR_COLUMNS, own.error.T, strict=True))
        sigmas = {f"sigma_{name}": values for name, values in zip(ERROR_COLUMNS, own.sigma.T, strict=True)}
        return {INDEX: own.t_s, **errors, **sigmas, "nees": own.nees}

    @cached_property
    def _drone_errors(self) -> dict[str, EstimateErrors]:
        return estimate_errors(self._judged[0])

    def _estimate_errors(self, drone: str) -> EstimateErrors:
        if drone not in self._drone_errors:
            known = ", ".join(self._drone_errors) or "of none"
            raise RecordError(f"{self.record}: truth and estimates of {drone} are not both on record; {known} are")
        return self._drone_errors[drone]


def _formation_statistics(formation: Formation, window: Window) -> "DataFrame":
    errors = formation.errors(window)
    columns = {
        name: np.array([getattr(each, name) for each in errors.values()], np.float64)
        for name in ParameterErrors.__struct_fields__
    }
    names, units = (np.array(each, object) for each in ([*errors], [*map(unit, errors)]))
    return frame({"variable": names, "unit": units, **columns}, "variable")


def _estimate_statistics(errors: EstimateErrors, window: Window) -> "DataFrame":
    rows = (errors.t_s >= window[0]) & (errors.t_s <= window[1])
    each = [values[np.isfinite(values)] for values in np.column_stack([errors.error, errors.nees])[rows].T]
    inside = [*(errors.share_inside(rows) if rows.any() else [np.nan] * len(ERROR_COLUMNS)), np.nan]
    columns: dict[str, list[Any]] = {
        "std": [values.std() if len(values) else np.nan for values in each],
        "rms": [np.sqrt(np.mean(values**2)) if len(values) else np.nan for values in each],
        "mean": [values.mean() if len(values) else np.nan for values in each],
        "inside": inside,
    }
    names = np.array([*ERROR_COLUMNS, "nees"], object)
    units = np.array(["rad" if "rad" in name else "m" if "_m_" in name else "" for name in names], object)
    return frame({"variable": names, "unit": units, **{k: np.array(v) for k, v in columns.items()}}, "variable")


def _there(given: str, names: Iterable[str]) -> str:
    """Return what there is in place of what was asked for, the most alike first."""
    names = list(names)
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f"{suggestion(given, names)}there are {', '.join(names[:SHOWN])}{more}" if names else "there are none"
