"""Faults of users' classes are reported with class, method, gate, and value or line; users' modules are found again."""

import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from shutil import move

import pytest
from federation import Federation
from refused import has_terms
from typer.testing import CliRunner

from zsim.errors import DocumentError, RunFailedError, UserCodeError
from zsim.record import RecordReader
from zsim.scenario import scenario_file
from zsim.schema import plugin
from zsim.sensors.sensor_catalogue import sensor_type
from zsim.vehicles.vehicle import vehicle_of
from zsim_analysis.in_process import fly
from zsim_analysis.reading.formation import formations_of
from zsim_analysis.reading.recorded_flight import read_flight
from zsim_analysis.reading.shortfall import verdict
from zsim_analysis.report import make_report
from zsim_analysis.rerun import rerun_record
from zsim_analysis.sweep import sweep_run
from zsim_analysis.sweep.sweep_run import Task
from zsim_deploy.cli.cli import app

PAIR = """
name: pair
duration_s: 12
drones: [{name: d1, position_m: [0, 3, 0]}, {name: d2, position_m: [0, -3, 0]}]
clusters: [{name: main, drones: [d1, d2], plan: {takeoff_s: 0.1}}]
"""
MODULE = '''
import numpy as np

from zsim.sensors.sensor import Channel, ErrorModel, RateHz, Sample, Sensor, SensorType
from zsim.schema.message import Number
from zsim_agents.estimation.paper_estimator import PaperEstimator
from zsim_agents.formation.control_law import ControlLaw
from zsim_agents.formation.spaces.triad_cluster import PairCluster


class Law(ControlLaw):
    """Raises in its hundredth gate, and returns NaN where the gain is another one."""

    calls = 0

    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        self.calls += 1
        r_dot = np.zeros(self.space.size)
        if self.calls > 100 and self.gains.k_1_s < 0.7:
            r_dot[7] = np.nan
        elif self.calls > 100:
            divided(0)  # called here
        return r_dot


def divided(number):
    return 1 / number  # raised here


class Exits(ControlLaw):
    calls = 0

    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        self.calls += 1
        if self.calls > 100:
            raise SystemExit  # quietly
        return np.zeros(self.space.size)


class Early(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return np.zeros(8) + np.zeros(7)  # of other shapes


class Complex(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return np.zeros(self.space.size) + 1j


class Mirrored(PaperEstimator):
    def estimate(self, t_s):
        return super().estimate(t_s)._replace(yaw_sigma_rad=-0.1)


class Unmade(PairCluster):
    def __init__(self):
        super().__init__()


class Estimator(PaperEstimator):
    def receive(self, sensor, message):
        if message.t_ns > 2_000_000_000:
            raise KeyError(sensor)
        super().receive(sensor, message)


class Space(PairCluster):
    def __init__(self, n):
        super().__init__()


class RangeOf(Sample, frozen=True):
    range_m: Number


class Settings(Sensor, frozen=True, kw_only=True):
    rate_hz: RateHz = 10.0
    range_m: ErrorModel = ErrorModel()


def distance(truth, settings, environment):
    return [np.inf if truth.t_s > 1.0 else 1.0]


def converted(numbers, settings, environment):
    conversions.append(numbers)
    return [numbers[0] / (len(conversions) < 9)]  # converted


conversions = []
SENSOR = SensorType(message=RangeOf, settings=Settings, channels=(Channel("range_m", "m"),), equation=distance)
'''


def line_of(text: str) -> int:
    return next(number for number, line in enumerate(MODULE.splitlines(), start=1) if text in line)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Yield a folder with a scenario and modules that it may name."""
    (tmp_path / "pair.yaml").write_text(PAIR)
    (tmp_path / "users_code.py").write_text(MODULE)
    converting = MODULE.replace("equation=distance)", "equation=distance, convert=converted)")
    (tmp_path / "users_conversion.py").write_text(converting)
    yield tmp_path
    forget(tmp_path)


def forget(folder: Path) -> None:
    """Make this process forget the modules of a folder, as if it were a new process."""
    for name in ("users_code", "users_conversion"):
        sys.modules.pop(name, None)
    sys.path[:] = [place for place in sys.path if not place.startswith(str(folder))]
    plugin.search()


LAW, ESTIMATOR = "clusters.main.law=users_code:Law", "estimation.algorithm=users_code:Estimator"
SENSOR = "sensors.beam={module: users_code}"
FAILURES = {
    "nan": ([LAW], ("controller.main at ", "users_code:Law.rates", "nan", "yaw rate of d2")),
    "raises": (
        [LAW, "clusters.main.gains.proportional_1_s=0.75"],
        ("controller.main at ", "users_code:Law.rates", "ZeroDivisionError", f"users_code.py:{line_of('# raised')}"),
    ),
    "estimator": (
        [ESTIMATOR],
        ("at 2.02 s", "users_code:Estimator.receive", "KeyError", f"users_code.py:{line_of('raise Key')}", "d1"),
    ),
    "exits": (
        ["clusters.main.law=users_code:Exits"],
        ("controller.main at ", "users_code:Exits.rates", "SystemExit", f"users_code.py:{line_of('# quietly')}"),
    ),
    "impossible": (["estimation.algorithm=users_code:Mirrored"], ("Mirrored.estimate", "yaw_sigma_rad", "-0.1")),
    "conversion": (
        ["sensors.beam={module: users_conversion}"],
        ("d1: sensors.beam at 0.", "converted", "ZeroDivisionError", f"users_conversion.py:{line_of('# converted')}"),
    ),
    "sensor": ([SENSOR], ("d1: sensors.beam at 1.", "users_code:distance", "inf")),
}


@pytest.mark.parametrize(("overrides", "terms"), FAILURES.values(), ids=FAILURES)
def test_a_failing_class_ends_the_run_with_its_failure_on_record(
    folder: Path, overrides: list[str], terms: tuple[str, ...]
) -> None:
    record = folder / "run.mcap"
    with pytest.raises(UserCodeError) as raised:
        fly(scenario_file.load(folder / "pair.yaml", overrides), record)
    line = str(raised.value)
    assert all(term in line for term in terms), line
    judged = verdict(record)
    assert judged.completeness.complete
    assert [each.text for each in judged.shortfalls if each.fails and each.kind == "process"] == [line]
    assert "end" in {event.kind for event in read_flight(record, motion=False).events}


@pytest.mark.parametrize(
    ("override", "terms"),
    [
        ("law=users_code:Early", ("Early.rates", "ValueError", f"users_code.py:{line_of('# of other shapes')}")),
        ("law=users_code:Complex", ("Complex.rates", "1.j")),
        ("space=users_code:Unmade", ("Unmade.for_places", "TypeError")),
    ],
)
def test_a_class_that_fails_before_the_flight_is_named(folder: Path, override: str, terms: tuple[str, ...]) -> None:
    with pytest.raises(UserCodeError) as raised:
        fly(scenario_file.load(folder / "pair.yaml", [f"clusters.main.{override}"]), None)
    assert all(term in str(raised.value) for term in ("'main'", *terms)), raised.value


def test_a_scenario_may_let_a_run_continue_without_a_failed_process(folder: Path) -> None:
    allowed = scenario_file.load(folder / "pair.yaml", [ESTIMATOR, "processes.on_death={controller.main: drop}"])
    assert fly(allowed, folder / "run.mcap") == "the scenario's duration is over"
    assert [each for each in verdict(folder / "run.mcap").shortfalls if each.kind == "process"] == []


def test_the_row_of_a_failed_sweep_run_holds_the_failure(folder: Path) -> None:
    row = sweep_run.fly(Task(0, 0, {}, scenario_file.load(folder / "pair.yaml", [ESTIMATOR])))
    assert all(term in row["failure"] for term in FAILURES["estimator"][1])


@pytest.mark.parametrize("name", ["nan", "raises", "estimator"])
def test_a_rerun_fails_at_the_same_gate_with_the_same_line(folder: Path, name: str) -> None:
    with pytest.raises(UserCodeError) as raised:
        fly(scenario_file.load(folder / "pair.yaml", FAILURES[name][0]), folder / "run.mcap")
    forget(folder)
    said: list[str] = []
    assert rerun_record(folder, False, said.append, said.append) == ""
    assert said[0].startswith("run again: world, ")
    assert said[-2].startswith("truth_sha256 is the same: ")
    assert said[-1] == f"ended as in the record: {raised.value}"


@pytest.mark.parametrize(
    ("old", "new", "terms"),
    [
        ("1 / number", "1.0", ("does not fail",)),
        ("calls > 100", "calls > 50", ("ZeroDivisionError", f"users_code.py:{line_of('# raised')}")),
    ],
)
def test_a_rerun_reports_that_a_changed_class_behaves_differently(
    folder: Path, old: str, new: str, terms: tuple[str, ...]
) -> None:
    with pytest.raises(UserCodeError):
        fly(scenario_file.load(folder / "pair.yaml", FAILURES["raises"][0]), folder / "run.mcap")
    forget(folder)
    (folder / "users_code.py").write_text(MODULE.replace(old, new))
    faults: list[str] = []
    try:
        faults.append(rerun_record(folder, False, lambda text: None, lambda text: None))
    except RunFailedError as error:
        faults.append(str(error))
    assert all(term in faults[0] for term in ("flown again, ", *terms)), faults


def flown(folder: Path) -> Path:
    """Record a run with a user's space and sensor; return the folder of the record."""
    scenario = scenario_file.load(
        folder / "pair.yaml",
        ["clusters.main.space=users_code:Space", "duration_s=1", "sensors.beam={module: users_code}"],
    )
    (folder / "run").mkdir()
    fly(scenario, folder / "run" / "run.mcap")
    forget(folder)
    return folder / "run"


def judged(run: Path) -> list[str]:
    """Fly a run again; return the names of the formations that a report judges."""
    forget(run.parent)
    faults: list[str] = []
    assert rerun_record(run, False, faults.append, faults.append) == ""
    return [formation.name for formation in formations_of(read_flight(run / "run.mcap"))]


def test_modules_are_found_where_the_run_found_them(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = flown(folder)
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert judged(run) == ["main"]


@pytest.mark.parametrize("beside", ["record", "working folder"])
def test_modules_are_found_beside_the_record_or_in_the_working_folder(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, beside: str
) -> None:
    run, there = flown(folder), tmp_path_factory.mktemp("elsewhere")
    monkeypatch.chdir(there)
    (there / "moved").mkdir()
    moved = Path(move(run, there / "moved" / "run"))
    move(folder / "users_code.py", (moved if beside == "record" else there) / "users_code.py")
    assert judged(moved) == ["main"]
    forget(there)


def test_a_missing_module_is_named(folder: Path) -> None:
    run = flown(folder)
    (folder / "users_code.py").unlink()
    forget(folder)
    with pytest.raises(DocumentError) as raised:
        formations_of(read_flight(run / "run.mcap"))
    assert "'users_code:Space'" in str(raised.value)


# Commands that only read run no user's module unless trusted

MARKED = (
    MODULE
    + """
from pathlib import Path

from zsim.vehicles.ardrone2 import VEHICLE

Path(__file__).with_name("executed").touch()


class Plain(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return np.zeros(self.space.size)


class Pair(PairCluster):
    @classmethod
    def for_places(cls, places_m):
        return cls()


def distance(truth, settings, environment):
    return [1.0]


SENSOR = SensorType(message=RangeOf, settings=Settings, channels=(Channel("range_m", "m"),), equation=distance)
"""
)
NAMED = {
    "law": "clusters.main.law=marked:Plain",
    "space": "clusters.main.space=marked:Pair",
    "estimator": "estimation.algorithm=marked:PaperEstimator",
    "sensor": "sensors.beam={module: marked}",
    "vehicle": "drones.d1.model=marked",
}


@pytest.fixture
def marked(folder: Path) -> Iterator[Path]:
    """Yield the path of the file that the module creates when it runs."""
    (folder / "marked.py").write_text(MARKED)
    yield folder / "executed"
    sys.modules.pop("marked", None)


def zsim(marked: Path, *arguments: str, runs: bool = False, code: int = 0) -> str:
    """Run a command as a new process would; check its exit code and whether it has run the module."""
    forget(marked.parent)
    sys.modules.pop("marked", None)
    sensor_type.cache_clear()
    vehicle_of.cache_clear()
    marked.unlink(missing_ok=True)
    done = CliRunner().invoke(app, list(arguments))
    assert (done.exit_code, marked.exists()) == (code, runs), (arguments, done.output, done.exception)
    return f"{done.output}\n{done.exception or ''}"


@pytest.mark.parametrize("name", NAMED)
def test_validate_runs_a_users_module_only_with_trust(marked: Path, name: str) -> None:
    command = ["validate", str(marked.parent / "pair.yaml"), "--set", NAMED[name]]
    text = zsim(marked, *command)
    assert has_terms(text, "note", "marked…", "--trust")
    assert ("name: pair" in text) is (name not in ("sensor", "vehicle"))  # the resolved scenario needs their numbers
    assert "name: pair" in zsim(marked, *command, "--trust", runs=True)
    assert has_terms(zsim(marked, *command[:3], NAMED[name].replace("marked", "nowhere"), code=1), "'nowhere…")


def test_fault_kinds_runs_a_users_module_only_with_trust(marked: Path) -> None:
    path = marked.parent / "pair.yaml"
    path.write_text(path.read_text() + "sensors: {beam: {module: marked}}\n")
    assert "beam" not in zsim(marked, "fault", "kinds", str(path))
    assert "beam" in zsim(marked, "fault", "kinds", str(path), "--trust", runs=True)


def test_report_export_and_rerun_run_a_users_module_only_with_trust(
    marked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make_report, "figures", lambda *_: [])  # drawing them takes longer than all the rest
    run = marked.parent / "run"
    run.mkdir()
    scenario = scenario_file.load(marked.parent / "pair.yaml", NAMED.values(), duration_s=1.0)
    fly(scenario, run / "run.mcap")
    assert has_terms(zsim(marked, "report", str(run)), "note", "marked:Pair", "--trust")
    zsim(marked, "report", str(run), "--trust", runs=True)
    assert has_terms(zsim(marked, "export", str(run), "--format", "foxglove"), "note", "marked:Pair", "--trust")
    zsim(marked, "export", str(run), "--format", "foxglove", "--force", "--trust", runs=True)
    assert has_terms(zsim(marked, "rerun", str(run), code=1), "marked:Plain", "--trust")
    zsim(marked, "rerun", str(run), "--trust", runs=True)
    with pytest.raises(DocumentError, match="come with all its numbers"):  # as from a manipulated record
        scenario_file.from_text("name: a\ndrones: [{name: d1, model: marked, position_m: [0, 0, 0]}]\n")
    assert "marked" in sys.modules  # the rerun has imported it


ENDLESS = """
import time
import zsim


class Endless(zsim.Agent):
    def __init__(self, drone):
        super().__init__()

    def receive(self, key, message):
        pass

    def step(self, t_ns):
        while t_ns >= 1_000_000_000:
            print("in the loop", flush=True)
            time.sleep(60)
        return []
"""


def test_an_endless_step_can_be_interrupted_and_keeps_the_record(
    federation: Federation,
) -> None:
    (federation.folder / "endless.py").write_text(ENDLESS)
    drone, rider = "{name: drone1, position_m: [0, 0, 0]}", "{class: 'endless:Endless', per: drone}"
    scenario = f"name: endless\nduration_s: 2\ndrones: [{drone}]\nagents: {{rider: {rider}}}\n"
    run = federation.run(scenario, "--in-process")
    run.line("in the loop")
    run.signal(signal.SIGINT)
    run.ends(with_code=130)
    assert re.search(r"rider.drone1 .* 1\.00 s \(.*endless\.py:16\)", run.text())
    with RecordReader(federation.out / "run.mcap") as reader:
        assert len(list(reader.messages(["drone/drone1/truth"]))) > 40
