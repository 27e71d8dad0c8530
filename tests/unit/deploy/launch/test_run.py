"""`zsim run` around its processes: their command lines, the port, and runs in one process."""

import io
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import pytest
from refused import has_terms, refused
from rich.console import Console
from short_flight import DIVERGED_NS, ONE, diverge
from synthetic_record import SCENARIOS

from zsim.contract import keys, messages
from zsim.errors import RunError, SessionError
from zsim.record import RecordReader
from zsim.runtime.progress import Screen
from zsim.scenario import scenario_file
from zsim_api.run_folder import new_launch
from zsim_deploy.arguments import changed_fields
from zsim_deploy.launch import run
from zsim_deploy.launch.role_launcher import ChildProcess, RoleLauncher
from zsim_deploy.launch.run import RunOptions
from zsim_deploy.launch.supervisor import Outcome

TAKEN = "the world died: exit code 2: cannot listen on tcp/127.0.0.1:{port} (Address already in use)"


class Say:
    """A screen that records its lines."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        self.lines.append(text)

    def hang_up(self) -> None: ...


class FakeSupervisor:
    """A supervisor whose runs end with the given outcomes; it records the ports on which worlds were to listen."""

    outcomes: ClassVar[list[str]] = []
    ports: ClassVar[list[int]] = []

    def __init__(self, *_: Any, **__: Any) -> None:
        self.members: list[Any] = []

    def handle_line(self, text: str) -> None: ...

    def run(self, _: object) -> Outcome:
        world = next(child for child in self.members if child.role == "world")
        endpoint = world._arguments[world._arguments.index("--listen") + 1]
        self.ports.append(int(endpoint.rsplit(":", 1)[1]))
        reason = self.outcomes.pop(0).format(port=self.ports[-1])
        return Outcome(reason, failed=reason != "ended")


class NoRoleLauncher(RoleLauncher):
    """A launcher that starts nothing."""

    def __enter__(self) -> RoleLauncher:
        return self

    def __exit__(self, *_: object) -> None: ...


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> type[FakeSupervisor]:
    FakeSupervisor.outcomes, FakeSupervisor.ports = [], []
    monkeypatch.setattr(run, "RoleLauncher", NoRoleLauncher)
    monkeypatch.setattr(run, "Supervisor", FakeSupervisor)
    monkeypatch.setattr(run, "is_free", lambda port: port == run.DEFAULT_PORT and not FakeSupervisor.ports)
    return FakeSupervisor


def options(out: Path, *overrides: str, cameras: bool = False, detect: bool = False, **how: Any) -> RunOptions:
    out.mkdir(exist_ok=True)
    scenario = scenario_file.load(SCENARIOS / "step.yaml", overrides)
    return RunOptions(scenario, out, new_launch(**how), cameras=cameras, detect=detect)


@pytest.mark.parametrize(
    ("outcomes", "listen", "fails", "tries"),
    [
        ([TAKEN, TAKEN, "ended"], None, False, 3),
        ([TAKEN], "tcp/127.0.0.1:20001", True, 1),  # a requested port is tried once
        (["the world died: killed by signal 9"], None, True, 1),
        ([TAKEN] * 100, None, True, run.PORTS_TRIED),
    ],
)
def test_a_port_taken_meanwhile_is_replaced_by_another(
    watched: type[FakeSupervisor], tmp_path: Path, outcomes: list[str], listen: str | None, fails: bool, tries: int
):
    watched.outcomes = list(outcomes)
    assert run.run_processes(options(tmp_path, listen=listen), Say()).failed == fails  # type: ignore[arg-type]
    assert watched.ports[0] == (20001 if listen else run.DEFAULT_PORT)
    assert len(set(watched.ports)) == len(watched.ports) == tries


def lines_of(made: RunOptions) -> dict[str, list[str]]:
    """Return the arguments of every process of a run."""
    children = run._children(made, "tcp/127.0.0.1:20001", FakeSupervisor(), NoRoleLauncher(print))  # type: ignore[arg-type]
    return {child.name: child._arguments for child in children if isinstance(child, ChildProcess)}


def test_the_world_gets_changed_fields_and_names_are_not_read_as_options(tmp_path: Path):
    changed = changed_fields(["wind.gust_m_s=1"], 12345678, 20.0)
    assert changed == ["wind.gust_m_s=1", "seed=12345678", "duration_s=20.0"]
    overrides = ("drones.drone1.name=-._", "clusters.main.drones=[-._, drone2, drone3]")
    lines = lines_of(options(tmp_path, *overrides, changed=tuple(changed)))
    assert [word for flag, word in pairwise(lines["world"]) if flag == "--changed"] == changed
    (line,) = (line for line in lines.values() if "-._" in line)
    assert line[0] == "estimator"
    assert line[-2:] == ["--", "-._"]


EYES = "sensors={preset: paper, front_camera: {}}"
BOTH = {"camera.main": [], "detector.main": []}
EACH = {f"detector.drone{i}": [f"drone{i}"] for i in (1, 2, 3)}
THE_OTHERS = {"camera.drone2": ["drone2"], "camera.main": ["drone1", "drone3"]}

# name: (overrides, --cameras, --detect, {process: drones, of which none stands for all with cameras})
CAMERAS: dict[str, tuple[list[str], bool, bool, dict[str, list[str]]]] = {
    "none": ([EYES], False, False, {}),
    "gating": ([EYES, "processes.gating=[camera]"], False, False, {"camera.main": []}),
    "all": ([EYES], True, True, BOTH),
    "one": ([EYES, "processes.expect=[camera.drone1]"], False, False, {"camera.drone1": ["drone1"]}),
    "the others too": ([EYES, "processes.expect=[camera.drone2]"], True, False, THE_OTHERS),
    "no others": ([EYES, f"processes.expect=[{', '.join(EACH)}]"], False, True, EACH),
    "main": ([EYES, "processes.expect=[camera.main, detector.main]"], False, False, BOTH),
    "names of one's own": ([EYES, "processes.expect=[camera.left, detector.left]"], False, False, {}),
    "somebody's own cameras": (["processes.expect=[camera.drone1, camera.main, detector.drone1]"], False, False, {"detector.drone1": ["drone1"]}),
}  # fmt: skip


@pytest.mark.parametrize("name", CAMERAS)
def test_the_requested_cameras_and_detectors_are_started(tmp_path: Path, name: str):
    overrides, cameras, detect, started = CAMERAS[name]
    made = options(tmp_path, *overrides, cameras=cameras, detect=detect)
    lines = {name: line for name, line in lines_of(made).items() if name.startswith(("camera.", "detector."))}
    assert {name: line[line.index("--") + 1 :] for name, line in lines.items()} == started
    assert all(line[line.index("--name") + 1] == name for name, line in lines.items())


@pytest.mark.parametrize(("cameras", "rate", "says"), [(True, 0.0, True), (True, 1.0, False), (False, 0.0, False)])
def test_a_run_too_fast_for_its_cameras_gives_a_hint(
    watched: type[FakeSupervisor], tmp_path: Path, cameras: bool, rate: float, says: bool
):
    watched.outcomes = ["ended"]
    screen = Say()
    run.run_processes(options(tmp_path, EYES, cameras=cameras, rate=rate), screen)  # type: ignore[arg-type]
    assert any(has_terms(line, "cameras", "--rate 1") for line in screen.lines) == says


@pytest.mark.parametrize(
    "endpoint", ["bogus", "tcp/127.0.0.1", "tcp/127.0.0.1:", "tcp/127.0.0.1:0", "tls/127.0.0.1:7000", ""]
)
def test_an_endpoint_is_checked_before_anything_starts(endpoint: str):
    for good in (None, "tcp/127.0.0.1:20001", "tcp/[::1]:20001", "tcp/localhost:20001"):
        run.check_endpoint(good, insecure=False)
    with pytest.raises(SessionError):
        run.check_endpoint(endpoint, insecure=False)


def test_a_run_in_one_process_reports_where_it_is_recorded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr("zsim_api.flight.fly", lambda *_: "over")
    screen, made = Say(), options(tmp_path, in_process=True)
    run.run_in_process(made, screen)  # type: ignore[arg-type]
    assert any(has_terms(line, "into", str(tmp_path)) for line in screen.lines)
    (tmp_path / "scenario.yaml").unlink()
    (tmp_path / "scenario.yaml").mkdir()
    with refused(RunError, "written"):
        run.run_in_process(made, screen)  # type: ignore[arg-type]


class NoStopChannel:
    """Leaves the signals to pytest."""

    def __init__(self, held_by: object) -> None: ...

    def reason(self) -> None:
        return

    def stopped(self) -> bool:
        return False

    def restore_signals(self) -> None: ...


def test_a_diverged_run_in_one_process_fails_and_keeps_its_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    diverge(monkeypatch)
    monkeypatch.setattr(run, "StopChannel", NoStopChannel)
    options = run.RunOptions(scenario_file.from_text(ONE), tmp_path, new_launch(in_process=True))
    outcome = run.run_in_process(options, Screen(1.0, Console(file=io.StringIO())))
    assert outcome.failed
    assert has_terms(outcome.reason, "d1", "0.120", "finite")
    with RecordReader(tmp_path / "run.mcap") as reader:
        recorded = [(m.key, messages.decode(m.key, m.payload)) for m in reader.messages()]
    assert [event.kind for key, event in recorded if key == keys.EVENT] == ["diverged", "end"]
    clocks = [clock for key, clock in recorded if key == keys.CLOCK]
    assert (clocks[-1].state, clocks[-1].t_ns) == ("stopped", DIVERGED_NS)
