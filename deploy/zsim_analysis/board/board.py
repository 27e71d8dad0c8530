"""Flies a board (every law in every scenario with every seed) and makes tables of the means.

The folder of a board:

    journal.jsonl    finished flights, one line of JSON each, from which the same command resumes
    board.csv        the measures of each flight
    board.md         their means over the seeds, a table for each scenario with a row for each law
    summary.json     the means, minima and maxima, for programs
    report.html      the tables and the figures

A law is `cluster_space`, the stock controller with a template; one of `zsim.scenario.scenario.LAWS`; or a user's
subclass of `zsim_agents.laws.pilot.Pilot`, `package.module:Class`. All fly the same drones from the same positions with
the same sensors, wind and seeds; a law has its default parameters, except for the times and positions of the plan.
"""

import copy
import csv
import hashlib
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from msgspec import Struct
from rich.console import Console

from zsim import __version__
from zsim.errors import ReportError, ScenarioError
from zsim.output_folder import locked_folder
from zsim.scenario import scenario_file
from zsim.scenario.scenario import LAWS, Scenario
from zsim_agents.hosting import check_classes
from zsim_agents.laws.pilot import FormationReference, polygon
from zsim_analysis.board.measures import Figure, formation_track, measures, shape_errors
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.sweep.process_pool import ProcessPool, cores
from zsim_analysis.sweep.sweep import Journal, SweepScreen, failures, read_journal
from zsim_analysis.sweep.sweep_run import Row, Task

JOURNAL, CSV, MARKDOWN = "journal.jsonl", "board.csv", "board.md"
OWN_FILES = (JOURNAL, CSV, MARKDOWN, "summary.json", "report.html", "figures", ".lock")
TRACK_S = 0.5  # interval between the samples of a flight that are kept for the figures
DECIMALS = 3  # decimals kept of times, positions and errors: to the millisecond or millimetre
CLUSTER_SPACE = "cluster_space"
LAW_NAMES = (CLUSTER_SPACE, *LAWS)
PILOT, CONTROLLER = "pilot", "main"
SERIES = ("track_t_s", "track_m", "track_shape_m")  # columns of a row that are not measures


class Measure(Struct, frozen=True):
    """A column of the board."""

    name: str  # key in a row
    title: str
    unit: str
    digits: int


MEASURES = (
    Measure("shape_error_m", "shape error", "m", 2),
    Measure("place_error_m", "place error", "m", 2),
    Measure("centre_error_m", "centre error", "m", 2),
    Measure("effort_m2_s", "control effort", "m²/s", 1),
    Measure("separation_m", "least separation", "m", 2),
    Measure("messages_per_drone_s", "messages per drone", "1/s", 1),
    Measure("cpu_per_s", "CPU per simulated second", "ms", 1),
    Measure("contacts", "contacts", "", 0),
)


class Entry(Struct, frozen=True):
    """A law's flights in a scenario: means, minima and maxima of the measures over the seeds."""

    scenario: str
    law: str
    flights: int
    failed: int
    means: dict[str, float | None]
    least: dict[str, float | None]
    greatest: dict[str, float | None]


class Board(Struct, frozen=True):
    """The results of all flights; laws and scenarios are in the order of the request."""

    laws: list[str]
    scenarios: list[str]
    seeds: int
    version: str
    entries: list[Entry]

    def entry(self, scenario: str, law: str) -> Entry:
        return next(each for each in self.entries if (each.scenario, each.law) == (scenario, law))


class BoardRequest(Struct, frozen=True):
    """A board to fly: laws, scenarios, seeds, output folder and number of processes."""

    laws: list[str]
    scenarios: list[str]
    seeds: int
    out: Path
    workers: int | None = None  # number of processes; None: one per core
    force: bool = False  # whether the folder may contain other files
    console: Console | None = None  # where progress is shown; None: stderr


def fly_board(request: BoardRequest) -> list[Row]:
    """Fly what the folder's journal lacks; return the rows of all flights.

    Raises:
        ScenarioError: a law cannot be flown; one line per fault.
        RunError: the folder contains something else, is in use or cannot be written, or workers cannot start.
        KeyboardInterrupt: the finished flights are in the journal.
    """
    tasks = _tasks(request)
    with locked_folder(request.out, JOURNAL, OWN_FILES, request.force, "write a board into", "another board runs"):
        rows_by_identity = {row["identity"]: row for row in read_journal(request.out / JOURNAL)}
        missing = [task for task in tasks if task.varied["identity"] not in rows_by_identity]
        with SweepScreen(len(tasks), len(tasks) - len(missing), request.console) as screen:
            extent = f"{len(request.laws)} laws, {len(request.scenarios)} scenarios, {request.seeds} seeds"
            screen.say(f"board: {extent}, into {request.out}")
            if missing:
                pool = ProcessPool(min(request.workers or cores(), len(missing)), screen.say)
                with Journal(request.out / JOURNAL) as journal, closing(pool.rows(iter(missing))) as rows:
                    for row in rows:
                        journal.append(row)
                        rows_by_identity[row["identity"]] = row
                        screen.finished(row["failure"] is not None)
            board_rows = [rows_by_identity[task.varied["identity"]] for task in tasks]
            for line in failures(board_rows):
                screen.say(line)
    return board_rows


def _tasks(request: BoardRequest) -> list[Task]:
    """Return the flights of a board ordered by seed, so that an unfinished board has all laws."""
    tasks: list[Task] = []
    faults: list[str] = []
    for law in request.laws:  # one check per law, in the first scenario, suffices
        try:
            check_classes(resolve_scenario(law, request.scenarios[0], 1), law)
        except ScenarioError as error:
            faults += error.faults
    if faults:
        raise ScenarioError(faults)
    for seed in range(1, request.seeds + 1):
        for scenario in request.scenarios:
            for law in request.laws:
                flight_scenario = resolve_scenario(law, scenario, seed)
                text = f"{__version__}\n{scenario_file.to_text(flight_scenario)}"
                varied = {"scenario": scenario, "law": law, "identity": hashlib.sha256(text.encode()).hexdigest()}
                tasks.append(Task(len(tasks), 0, varied, flight_scenario, more=partial(columns, law, scenario)))
    return tasks


def columns(law: str, scenario: str, flight: RecordedFlight) -> dict[str, Any]:
    """Return the measures of a flight, and its drones' positions and shape errors every TRACK_S."""
    figure = planned_figure(scenario) if law == CLUSTER_SPACE else None
    formation = formation_track(flight, figure, entire_flight=True)
    step = max(1, round(TRACK_S / float(np.median(np.diff(formation.t_s))))) if len(formation.t_s) > 1 else 1
    series = dict(
        zip(SERIES, (formation.t_s[::step], formation.p[::step], shape_errors(formation)[::step]), strict=True)
    )  # fmt: skip
    results = measures(flight, figure)
    cpu = results["cpu_per_s"]
    contacts = sum(event.kind == "collision" for event in flight.events)
    rounded_series = {name: np.round(values, DECIMALS).tolist() for name, values in series.items()}
    return {**results, "cpu_per_s": None if cpu is None else 1e3 * cpu, "contacts": float(contacts), **rounded_series}


def planned_figure(scenario: str) -> Figure:
    """Return the figure that the stock controller is to form in a scenario."""
    entry, flight = board_document()["scenarios"][scenario], board_document()["flight"]
    positions = polygon(len(board_document()["base"]["drones"]), flight["radius_m"])
    return Figure(FormationReference(entry["centre_m"], 0.0, 1.0, flight["start_s"]), positions, ("translation",))


def board_of(request: BoardRequest, rows: Sequence[Row]) -> Board:
    """Return the board, with statistics over the seeds of the flights that did not fail."""
    entries = []
    for scenario in request.scenarios:
        for law in request.laws:
            all_rows = [row for row in rows if (row["scenario"], row["law"]) == (scenario, law)]
            completed_rows = [row for row in all_rows if row["failure"] is None]
            values = {
                each.name: [row[each.name] for row in completed_rows if row[each.name] is not None] for each in MEASURES
            }
            statistics = [
                {name: float(reduce(samples)) if samples else None for name, samples in values.items()}
                for reduce in (np.mean, min, max)
            ]
            entries.append(Entry(scenario, law, len(all_rows), len(all_rows) - len(completed_rows), *statistics))
    return Board(request.laws, request.scenarios, request.seeds, __version__, entries)


def cells(entry: Entry) -> list[str]:
    """Return the means of an entry as text, in the order of MEASURES, with a dash for each missing mean."""
    values = [(each, entry.means[each.name]) for each in MEASURES]
    return ["–" if value is None else f"{value:.{each.digits}f}" for each, value in values]


def heads() -> list[str]:
    return [f"{each.title} ({each.unit})" if each.unit else each.title for each in MEASURES]


def _markdown(board: Board) -> Iterator[str]:
    for scenario in board.scenarios:
        yield f"### {scenario}\n\n{about(scenario)[0].upper()}{about(scenario)[1:]}.\n\n"
        yield f"| law | {' | '.join(heads())} |\n|---|{'--:|' * len(MEASURES)}\n"
        for law in board.laws:
            yield f"| {law} | {' | '.join(cells(board.entry(scenario, law)))} |\n"
        yield "\n"


def write_tables(out: Path, board: Board, rows: Sequence[Row]) -> None:
    """Write board.csv and board.md; raise ReportError if the folder cannot be written."""
    names = ["scenario", "law", "seed", "failure", *(each.name for each in MEASURES), "truth_sha256"]
    text = io.StringIO()
    writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    try:
        (out / CSV).write_text(text.getvalue(), encoding="utf-8")
        (out / MARKDOWN).write_text("".join(_markdown(board)), encoding="utf-8")
    except OSError as error:
        raise ReportError(f"{out}: cannot be written ({error.strerror})") from error


@cache
def board_document() -> Mapping[str, Any]:
    return yaml.safe_load(files("zsim_analysis.board").joinpath("scenarios.yaml").read_text(encoding="utf-8"))


def scenario_names() -> list[str]:
    return [*board_document()["scenarios"]]


def about(scenario: str) -> str:
    return board_document()["scenarios"][scenario]["about"]


def select_names(given: str | None, known: Sequence[str], option: str, open_to_classes: bool = False) -> list[str]:
    """Return the names of a comma-separated list without repetitions; all known names if it is None or empty.

    Raises:
        ScenarioError: the list contains only commas, or unknown names; one line per name.
    """
    names = [*dict.fromkeys(name.strip() for name in given.split(",") if name.strip())] if given else [*known]
    allowed = f"must be one of {', '.join(known)}{', or package.module:Class' if open_to_classes else ''}"
    unknown = [name for name in names if name not in known and not (open_to_classes and ":" in name)]
    if not names:
        raise ScenarioError([f"{option} is {given!r}; {allowed}"])
    if unknown:
        raise ScenarioError([f"{option} has {name!r}; {allowed}" for name in unknown])
    return names


def resolve_scenario(law: str, scenario: str, seed: int) -> Scenario:
    """Return the resolved scenario of a flight; raise ScenarioError if a user's class cannot be flown."""
    return scenario_file.resolve(document(law, scenario, seed), f"board, {law} in {scenario}")


def document(law: str, scenario: str, seed: int) -> dict[str, Any]:
    """Return the scenario of a flight as a raw document."""
    entry, flight = board_document()["scenarios"][scenario], board_document()["flight"]
    result = copy.deepcopy(board_document()["base"])
    result |= {"name": f"board-{scenario.replace('_', '-')}", "seed": seed, "report": {"window_s": entry["window_s"]}}
    for path, value in entry.get("set", {}).items():
        *sections, last = path.split(".")
        section_fields = result
        for section in sections:
            section_fields = section_fields.setdefault(section, {})
        section_fields[last] = copy.deepcopy(value)
    names = [drone["name"] for drone in result["drones"]]
    loss_probability = entry.get("radio", {}).get("loss", 0.0)
    if law == CLUSTER_SPACE:
        result["clusters"] = [_cluster(names, entry["centre_m"], flight)]
        links = [f"estimator.{name}/controller.{CONTROLLER}" for name in names] + [f"world/controller.{CONTROLLER}"]
        losses = (
            [{"kind": "link_loss", "target": link, "probability": loss_probability} for link in links]
            if loss_probability
            else []
        )
        result["faults"] = [*result.get("faults", []), *losses]
        return result
    parameters = {"takeoff_s": flight["takeoff_s"], "height_m": flight["height_m"], "start_s": flight["start_s"]}
    result["agents"] = {PILOT: {"class": law, "parameters": {**parameters, "centre_m": entry["centre_m"]}}}
    if loss_probability:
        result["radio"] = {"loss": loss_probability}
    return result


def _cluster(names: list[str], centre_m: list[float | str], flight: Mapping[str, Any]) -> dict[str, Any]:
    """Return the equivalent cluster: a polygon as template, which gathers and then follows the centre's path."""
    positions = [[*position, 0.0] for position in polygon(len(names), flight["radius_m"]).tolist()]
    start = {"x_c": 0, "y_c": 0, "z_c": flight["height_m"], "yaw": 0}
    expressions = {"x_c": centre_m[0], "y_c": centre_m[1]}
    trajectory = {"start_s": flight["start_s"], "expressions": expressions}
    plan = {"takeoff_s": flight["takeoff_s"], "target": start, "trajectory": trajectory}
    return {"name": CONTROLLER, "drones": names, "space": "template", "template_m": positions, "plan": plan}
