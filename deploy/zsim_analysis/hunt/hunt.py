"""Flies a hunt into its folder: a space of flights and requirements in; the first violation, shrunk to its causes, out.

The folder of a hunt:

    hunt.json            the request, with its seed
    flights.csv          a row for each flight, in order: faults, values, margins
    summary.json, report.html, figures/
    violation.yaml       the scenario with the remaining causes
    violation/           the flight of that scenario: record, report, figures
    violation.zsim       its bundle, in one file
"""

import csv
import io
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import lru_cache, partial
from pathlib import Path
from shutil import rmtree
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import replace
from rich.console import Console

from zsim import __version__
from zsim.errors import ReportError, RunError, ScenarioError
from zsim.output_folder import locked_folder
from zsim.scenario.faults import PROCESS_KILL
from zsim.scenario.scenario import Scenario
from zsim.schema import yaml_file
from zsim_analysis.hunt.requirements import BROKEN, Margin, Requirement, quantities_of, worst
from zsim_analysis.hunt.shrink import Shrinker, causes_of, reduced_to
from zsim_analysis.hunt.space import PENDING_MAX, WIND, Case, HuntSpace, Strategy
from zsim_analysis.report import indented_json
from zsim_analysis.report.summary import RunSummary, summarise
from zsim_analysis.sweep.design import METRICS, text_of
from zsim_analysis.sweep.process_pool import ProcessPool, cores
from zsim_analysis.sweep.sweep import SweepScreen, duration_text
from zsim_analysis.sweep.sweep_run import FIXED, METRIC, Row, Task, fly_scenario

PLAN, TABLE, SCENARIO, VIOLATION = "hunt.json", "flights.csv", "violation.yaml", "violation"
BUNDLE = "violation.zsim"
OWN_FILES = (PLAN, TABLE, SCENARIO, VIOLATION, BUNDLE, "summary.json", "report.html", "figures", ".lock")
SEARCH, CAUSE, RECORD = "search", "each cause", "record"  # stages besides those of `shrink`
SAME_BITS = "same_bits"  # quantity: whether the truth is bit-identical to that of the flight without process deaths
MISSES_MAX = 100  # successive draws that cannot be flown, after which --vary is deemed wrong; design choice
DECIMALS = 6  # decimals of margins in the table


class HuntRequest(Struct, frozen=True):
    """A hunt to fly: scenario, requirements, folder and limits.

    `flights` and `budget_s` limit the search; shrinking a violation takes about a hundred more flights.
    """

    document: dict[str, Any]  # the scenario's document, with the overrides of the command line
    source: str  # name of the scenario's file, for messages
    requirements: tuple[str, ...]  # comparisons, or the user's functions, `module:function`
    out: Path
    seed: int = 1  # seed of the draws
    flights: int | None = None
    budget_s: float | None = None
    faults: tuple[str, ...] = ()  # texts of `--fault`; empty: all kinds except deaths of processes
    without: tuple[str, ...] = ()  # kinds of faults that are not drawn
    vary: tuple[str, ...] = (WIND,)
    changed: tuple[str, ...] = ()  # overrides `a.b.c=value` already applied to the document
    most: int = 3  # largest number of faults in one flight
    workers: int | None = None  # number of processes; None: one per core
    force: bool = False  # whether the folder may hold other files
    console: Console | None = None  # where progress is shown; None: stderr
    open_run: Callable[[Path], Any] | None = None  # see Task
    processes: Callable[[Scenario, Path], None] | None = None  # see Task; for flights in which processes die


class HuntFlight(Struct, frozen=True):
    number: int
    stage: str
    case: Case
    margins: list[Margin]  # by requirement
    failure: str | None = None
    truth_sha256: str | None = None
    shortfall: str | None = None

    @property
    def worst(self) -> Margin:
        return worst(self.margins)

    @property
    def holds(self) -> bool:
        return all(margin.holds for margin in self.margins)


class Stage(Struct, frozen=True):
    """Number of flights and wall time of a stage of a hunt."""

    name: str
    flights: int
    wall_s: float


class CauseFound(Struct, frozen=True):
    """One cause of a violation, with the requirement's margins in a flight without it and in one with it alone."""

    text: str
    without: float | None
    alone: float | None


class Violation(Struct, frozen=True):
    """A violation of a requirement."""

    requirement: str
    number: int  # number of the flight in which it was found
    found: Case
    shrunk: Case
    margin: float | None  # margin of the recorded flight, or else of the one found; None if it is unknown
    unknown: str  # the unknown quantity, or why the flight failed
    causes: list[CauseFound]
    options: list[str]  # options with which `zsim run SCENARIO` flies the shrunk case
    truth_sha256: str | None


class Tried(Struct, frozen=True):
    """How many of the possible combinations of `together` kinds of faults were tried."""

    together: int
    tried: int
    possible: int


class HuntSummary(Struct, frozen=True, kw_only=True):
    """The content of summary.json."""

    scenario: str
    requirements: tuple[str, ...]
    seed: int
    version: str = __version__
    verdict: str  # "violated", "not violated", or "interrupted" if neither is known
    interrupted: bool = False  # by Ctrl-C
    flights: int
    wall_s: float
    stages: list[Stage]
    coverage: list[Tried]
    least: list[float | None]  # smallest margin of each requirement in the search
    violation: Violation | None = None


class Hunted(Struct, frozen=True):
    """A finished hunt."""

    request: HuntRequest
    space: HuntSpace
    summary: HuntSummary
    flown: list[HuntFlight]


def hunt(request: HuntRequest) -> Hunted:
    """Search until a requirement is violated or the budget is spent; return the results, also after Ctrl-C.

    Raises:
        ScenarioError: a requirement, a fault, a field or the scenario is wrong; one line for each.
        RunError: the folder holds another hunt or other files, is in use or cannot be created, or workers cannot start.
        ReportError: the folder cannot be written.
    """
    texts, document = _with_functions(request.requirements, request.document)
    requirements = _requirements(texts)
    space = HuntSpace(document, request.source, request.faults, request.without, request.vary, request.most)
    if (request.out / PLAN).exists() and not request.force:
        raise RunError(f"{request.out}: already holds a hunt; --force replaces it, or give --out another folder")
    with locked_folder(request.out, PLAN, OWN_FILES, request.force, "hunt into", "another hunt is running"):
        rmtree(request.out / VIOLATION, ignore_errors=True)  # left by an earlier hunt
        for name in (SCENARIO, BUNDLE):
            (request.out / name).unlink(missing_ok=True)
        current = _Hunt(request, space, texts, requirements)
        hunted = Hunted(request, space, current.run(), current.results)
        write(hunted)
    return hunted


def _with_functions(requirements: Sequence[str], document: Mapping[str, Any]) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return requirements as comparisons, and the document with their functions as metrics."""
    texts, report = [], dict(document.get("report") or {})
    metrics = report.get("metrics") or []
    names = [metrics] if isinstance(metrics, str) else list(metrics)
    for text in requirements:
        module, colon, function = text.partition(":")
        if colon and function.isidentifier() and all(part.isidentifier() for part in module.strip().split(".")):
            names += [] if text.strip() in names else [text.strip()]
            text = f"{METRIC}{function} > 0"
        texts.append(text)
    if not names:
        return tuple(texts), dict(document)
    return tuple(texts), {**document, METRICS.partition(".")[0]: {**report, METRICS.partition(".")[2]: names}}


def _requirements(texts: Sequence[str]) -> list[Requirement]:
    requirements, faults = [], []
    for text in texts:
        try:
            requirements.append(Requirement(text))
        except ScenarioError as error:
            faults += error.faults
    if faults or not requirements:
        raise ScenarioError(faults or ["--require is missing; must be a condition, such as 'min_separation_m > 1.5'"])
    return requirements


_requirement = lru_cache(maxsize=64)(Requirement)


def judge_flight(requirements: Sequence[str], twin: Scenario | None, summary: RunSummary, row: Row) -> dict[str, Any]:
    """Return the margins of a flight, or why they cannot be computed; called in the process that flew it.

    `twin` is the same flight without deaths of processes, flown for SAME_BITS; None if the flight has none.
    """
    columns = {name: row[name] for name in row if name in FIXED or name.startswith((METRIC, "clusters."))}
    quantities = {**columns, **dict(quantities_of(msgspec.to_builtins(summary)))}
    parsed = [_requirement(text) for text in requirements]
    names = [name for each in parsed for name in each.names]
    if SAME_BITS in names:
        is_identical = twin is None
        if twin is not None:
            twin_flight, diverged = fly_scenario(twin)
            is_identical = not diverged and summarise(twin_flight, [], Path()).truth_sha256 == summary.truth_sha256
        quantities[SAME_BITS] = is_identical
    if row.get("metrics_failure"):  # missing metrics are unknown, not wrong
        quantities = {**{name: None for name in names if name.startswith(METRIC)}, **quantities}
    faults = [fault for each in parsed for fault in each.faults(quantities)]
    try:
        return {"faults": faults, "margins": [] if faults else [tuple(each.margin(quantities)) for each in parsed]}
    except ScenarioError as error:
        return {"faults": error.faults, "margins": []}


class _Hunt:
    def __init__(
        self, request: HuntRequest, space: HuntSpace, texts: Sequence[str], requirements: Sequence[Requirement]
    ) -> None:
        self._request, self._space = request, space
        self._texts, self._requirements = tuple(texts), requirements
        self._strategy = Strategy(space, request.seed)
        self._screen = HuntScreen(request, self._strategy)
        self.results: list[HuntFlight] = []
        self._scales: list[float] = []  # absolute margins of the flight without faults, by requirement
        self._stages: Counter[str] = Counter()
        self._spent_s: defaultdict[str, float] = defaultdict(float)
        self._waiting: deque[Task] = deque()
        self._cases: list[tuple[Case, str]] = []  # by flight number
        self._rows: dict[int, Row] = {}
        self._done = False

    def run(self) -> HuntSummary:
        began_s, verdict = time.monotonic(), "not violated"
        violation: Violation | None = None
        interrupted = False
        with self._screen as screen:
            kinds = f"{len(self._space.kinds)} kinds of faults, {self._space.faults_max} in a flight"
            screen.say(f"{self._request.source}: {kinds}, into {self._request.out}")
            pool = ProcessPool(self._request.workers or cores(), screen.say)
            try:
                with closing(pool.rows(self._tasks())) as self._flying:
                    violating = self._timed(SEARCH, self._search)
                    if violating:
                        verdict = "violated"
                        smallest_case = violating.case
                        violation = self._violation(violating, smallest_case, [])
                        for smallest_case in self._shrink(violating):
                            violation = self._violation(violating, smallest_case, [])
                        violation = self._timed(RECORD, partial(self._record_violation, violating, smallest_case))
                    self._done = True
            except KeyboardInterrupt:
                interrupted, verdict = True, verdict if violation else "interrupted"
                screen.say("interrupted; what was found so far is kept")
        stages = [Stage(name, self._stages[name], round(self._spent_s[name], 2)) for name in self._spent_s]
        coverage = self._strategy.coverage
        tried = [Tried(size, coverage.tried(size), len(sets)) for size, sets in coverage.possible.items()]
        searched = [each for each in self.results if each.stage == SEARCH]
        values = [[each.margins[i].value for each in searched] for i in range(len(self._requirements))]
        return HuntSummary(
            scenario=self._request.source,
            requirements=tuple(each.text for each in self._requirements),
            seed=self._request.seed,
            verdict=verdict,
            interrupted=interrupted,
            flights=len(self.results),
            wall_s=round(time.monotonic() - began_s, 2),
            stages=stages,
            coverage=tried,
            least=[min((x for x in each if x is not None), default=None) for each in values],
            violation=violation,
        )

    def _timed(self, stage: str, call: Callable[[], Any]) -> Any:
        began_s = time.monotonic()
        try:
            return call()
        finally:
            self._spent_s[stage] += time.monotonic() - began_s

    # Flights

    def _tasks(self) -> Iterator[Task | None]:
        while not self._done:
            yield self._waiting.popleft() if self._waiting else None

    def _submit(self, case: Case, stage: str, record: Path | None = None) -> int:
        """Queue the flight of a case and return its number; raise ScenarioError if it cannot be flown."""
        scenario, number = self._space.scenario(case), len(self._cases)
        self._cases.append((case, stage))
        deadly = [fault for fault in case.faults if fault["kind"] == PROCESS_KILL]
        twin = replace(case, faults=tuple(fault for fault in case.faults if fault not in deadly))
        self._waiting.append(
            Task(
                run=number,
                point=0,
                varied={},
                scenario=scenario,
                record=str(record.absolute()) if record else None,
                open_run=self._request.open_run,
                processes=self._request.processes if deadly else None,
                judge=partial(judge_flight, self._texts, self._space.scenario(twin) if deadly else None),
            )
        )
        return number

    def _result(self, number: int) -> HuntFlight:
        """Wait for the result of a flight and add it to the table."""
        while number not in self._rows:
            row = next(self._flying)
            self._rows[row["run"]] = row
            self._screen.finished(row["failure"] is not None)
        row, (case, stage) = self._rows.pop(number), self._cases[number]
        if row.get("faults"):
            raise ScenarioError(row["faults"])
        failure = row["failure"]
        failed_margin = Margin(False, BROKEN, None, failure or "")
        margins = (
            [Margin(*each) for each in row["margins"]] if not failure else [failed_margin for _ in self._requirements]
        )
        if not self._scales:
            self._scales = [abs(each.value) if each.value else 1.0 for each in margins]
        margins = [
            each if each.value is None else each._replace(share=each.value / scale)
            for each, scale in zip(margins, self._scales, strict=True)
        ]
        result = HuntFlight(len(self.results), stage, case, margins, failure, row["truth_sha256"], row["shortfall"])
        self._stages[stage] += 1
        self.results.append(result)
        return result

    def _fly(self, cases: Sequence[Case], stage: str) -> list[HuntFlight | None]:
        """Fly cases in parallel; return None for a case that cannot be flown."""
        numbers: list[int | None] = []
        for case in cases:
            try:
                numbers.append(self._submit(case, stage))
            except ScenarioError:
                numbers.append(None)
        return [None if number is None else self._result(number) for number in numbers]

    # Stages

    def _search(self) -> HuntFlight | None:
        """Return the first flight by number that violates a requirement; None if the budget runs out first."""
        flights, budget_s = self._request.flights, self._request.budget_s
        until_s = None if budget_s is None else time.monotonic() + budget_s
        pending: deque[int] = deque()
        drawn_count = misses = 0
        try:
            while True:
                while (
                    len(pending) < PENDING_MAX
                    and (flights is None or drawn_count < flights)
                    and (drawn_count == 0 or self.results)
                ):
                    drawn_count += 1
                    try:
                        pending.append(self._submit(self._strategy.draw(), SEARCH))
                    except ScenarioError:  # e.g. a normally distributed value beyond the limits of its field
                        misses += 1
                        if misses == MISSES_MAX:
                            raise
                        continue
                    misses = 0
                    if drawn_count == 1:
                        break  # the flight without faults shows whether all quantities exist
                if not pending or (until_s is not None and time.monotonic() >= until_s):
                    return None
                result = self._result(pending.popleft())
                self._strategy.learn(result.case, result.worst)
                self._screen.margin = min(self._screen.margin, result.worst.share)
                if not result.holds:
                    return result
        finally:
            self._waiting.clear()

    def _shrink(self, violating: HuntFlight) -> Iterator[Case]:
        index = violating.margins.index(violating.worst)
        is_unknown, failed = bool(violating.worst.unknown), violating.failure is not None

        outcomes: dict[bytes, bool] = {}  # results of the cases flown so far

        def violates(cases: Sequence[Case], stage: str) -> list[bool]:
            self._screen.stage = stage
            names = [msgspec.json.encode(case) for case in cases]
            new = {name: case for name, case in zip(names, cases, strict=True) if name not in outcomes}
            result = self._timed(stage, lambda: self._fly([*new.values()], stage))
            outcomes.update({name: is_same_violation(each) for name, each in zip(new, result, strict=True)})
            return [outcomes[name] for name in names]

        def is_same_violation(result: HuntFlight | None) -> bool:
            if result is None or (result.failure is not None) != failed:
                return False
            margin = result.margins[index]
            return not margin.holds and bool(margin.unknown) == is_unknown

        margin_text = violating.worst.unknown or f"margin {violating.worst.value:.3g}"
        self._screen.say(
            f"flight {violating.number} violates {self._requirements[index].text} ({margin_text}); shrinking it"
        )
        yield from Shrinker(self._space, violates).shrink(violating.case)

    def _violation(
        self, violating: HuntFlight, case: Case, causes: list[CauseFound], recorded: HuntFlight | None = None
    ) -> Violation:
        index, result = violating.margins.index(violating.worst), recorded or violating
        return Violation(
            requirement=self._requirements[index].text,
            number=violating.number,
            found=violating.case,
            shrunk=case,
            margin=result.margins[index].value,
            unknown=result.margins[index].unknown,
            causes=causes,
            options=self._space.options(case),
            truth_sha256=recorded.truth_sha256 if recorded else None,
        )

    def _record_violation(self, violating: HuntFlight, case: Case) -> Violation:
        """Fly the shrunk case for its record, and further cases that show the effect of each cause."""
        index, causes = violating.margins.index(violating.worst), causes_of(case)
        self._screen.stage = RECORD
        record_path = self._request.out / VIOLATION
        number = self._submit(case, RECORD, record_path)
        without = self._fly([reduced_to(case, [other for other in causes if other != each]) for each in causes], CAUSE)
        alone = self._fly([reduced_to(case, [each]) for each in causes], CAUSE)
        table = [
            CauseFound(cause_text(case, each), *(one and one.margins[index].value for one in two))
            for each, *two in zip(causes, without, alone, strict=True)
        ]
        return self._violation(violating, case, table, self._result(number))


def cause_text(case: Case, cause: tuple[str, int | str]) -> str:
    """Format a cause as on the command line."""
    kind, key = cause
    return f"{key}={text_of(case.values[str(key)])}" if kind == "value" else fault_text(case.faults[int(key)])


def fault_text(fault: Mapping[str, Any]) -> str:
    """Format a fault as the arguments of `zsim fault add`."""
    words = [str(fault["target"]), str(fault["kind"])]
    words += [f"{name}={text_of(v)}" for name, v in fault.items() if name not in ("kind", "target", "at_s", "for_s")]
    words += [f"--for {fault['for_s']:g}s"] if "for_s" in fault else []
    return " ".join([*words, *([f"--at {fault['at_s']:g}s"] if "at_s" in fault else [])])


# The folder


def write(hunted: Hunted) -> None:
    """Write hunt.json, flights.csv and violation.yaml; raise ReportError if the folder cannot be written."""
    request, summary = hunted.request, hunted.summary
    plan = {
        "scenario": request.source, "requirements": request.requirements, "seed": request.seed,
        "flights": request.flights, "budget_s": request.budget_s, "faults": request.faults,
        "without": request.without, "vary": request.vary, "most": request.most, "version": __version__,
        "document": request.document,
    }  # fmt: skip
    try:
        (request.out / PLAN).write_bytes(indented_json(plan))
        (request.out / TABLE).write_text(table(hunted), encoding="utf-8")
        if summary.violation:
            text = yaml_file.dump(hunted.space.changed(summary.violation.shrunk))
            (request.out / SCENARIO).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ReportError(f"{request.out}: cannot be written ({error.strerror})") from error


def table(hunted: Hunted) -> str:
    """Return the text of flights.csv."""
    text, paths = io.StringIO(), list(hunted.space.fields)
    writer = csv.writer(text, lineterminator="\n")
    margins = [f"margin of {each}" for each in hunted.summary.requirements]
    head = ["flight", "stage", "holds", *margins, "unknown", "seed", "duration_s", *paths, "faults", "failure"]
    writer.writerow([*head, "shortfall", "truth_sha256"])
    for each in hunted.flown:
        values = [None if m.value is None else round(m.value, DECIMALS) for m in each.margins]
        fields = [each.case.values.get(path) for path in paths]
        faults = "; ".join(map(fault_text, each.case.faults))
        duration_s = each.case.duration_s or hunted.space.base.duration_s
        unknown = next((m.unknown for m in each.margins if m.unknown), None)
        row = [each.number, each.stage, each.holds, *values, unknown, each.case.seed, duration_s, *fields, faults]
        writer.writerow([*row, each.failure, each.shortfall, each.truth_sha256])
    return text.getvalue()


class HuntScreen(SweepScreen):
    """Shows the progress of a hunt: flights, combinations tried, smallest margin, remaining budget."""

    def __init__(self, request: HuntRequest, strategy: Strategy) -> None:
        self._request, self._coverage = request, strategy.coverage
        self.stage, self.margin = SEARCH, float("inf")
        super().__init__(2**62, 0, request.console)

    def line(self) -> str:
        elapsed_s = self._now_s() - self._start_s
        text = f"{self.stage}: {self._done:,} flights"
        if self._done and elapsed_s > 0:
            text += f", {60 * self._done / elapsed_s:,.0f} a minute"
        names = {1: "kinds", 2: "pairs", 3: "triples"}
        for size, sets in self._coverage.possible.items():
            text += f"  {self._coverage.tried(size):,}/{len(sets):,} {names[size]}"
        if self.margin < float("inf"):
            text += f"  least margin {self.margin:.0%}"
        if self.stage == SEARCH and self._request.budget_s is not None:
            text += f"  {duration_text(max(0.0, self._request.budget_s - elapsed_s))} to go"
        return text
