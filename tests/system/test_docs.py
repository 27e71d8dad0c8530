"""Checks of the documentation: every command, scenario, example, link and table in README.md and docs/*.md.

The line that opens a fenced block states how the block is checked:

    bash run            executed as it stands, line by line; must succeed
    bash terminals      each line runs as a process, as in a separate terminal, until the next heading
    bash with PROGRAM   as `bash run` if PROGRAM is installed; otherwise the test is skipped after the other blocks
    bash elsewhere      not for this machine (installation, other hosts); every `zsim` line must parse, and every
                        other line must begin with an entry of ELSEWHERE
    yaml, yaml part     a whole scenario; top-level sections to be merged into scenarios/step.yaml
    yaml inventory      a whole inventory, which must suit scenarios/step.yaml
    python              must compile
    python run          executed; all blocks of a page form one script
    python test         a file of tests, run by pytest
    yaml github, yaml gitlab    CI files, valid by their vendors' schemas
    text, json          output and drawings, not checked

A block of any other kind is an error, so that no block goes unchecked by mistake. Commands run as printed, except for
what `adapted` changes: endpoints, shorter durations, a faster pace in realtime, and no reports of sweeps or of runs
without --out.
"""

import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import chdir, suppress
from functools import cache
from itertools import groupby
from pathlib import Path
from runpy import run_path
from typing import Any, NamedTuple
from urllib.request import urlopen

import msgspec
import pytest
import typer
import yaml
from federation import free_port
from forked_commands import run_here, start_in
from msgspec import inspect as types
from near_worker import sweep_here

from zsim.contract import messages
from zsim.contract.run_messages import EVENT_KINDS
from zsim.scenario import scenario, scenario_file
from zsim.schema import quantities
from zsim.sensors.camera import CAMERAS, BottomCamera, FrontCamera, Hats, SightingModel
from zsim.sensors.scanner import DepthConfig, LidarConfig, RangeConfig
from zsim.sensors.sensor import ErrorModel, Mount, Sensor
from zsim.sensors.sensor_catalogue import AS_PRINTED, PRESETS, STOCK, Sensors
from zsim.vehicles import vehicle
from zsim_analysis.report.figure_style import ReportFigure
from zsim_deploy import inventory
from zsim_deploy.cli.cli import app
from zsim_deploy.launch.role_launcher import RoleProcess

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
PNG = b"\x89PNG"
RUN_S = 4.0  # simulated duration of a run or sweep in a `bash run` block
LONG = (
    "cameras.md",
    "clients.md",
    "decentralised.md",
    "deployment.md",
    "estimation.md",
    "extending.md",
    "faults.md",
    "fmu.md",
    "hunt.md",
    "laws.md",
    "obstacles.md",
    "project.md",
    "records.md",
    "references.md",
    "sweep.md",
    "testing.md",
)  # pages that only the soak tests run, because other tests cover what they show
PATIENCE_S = 600  # wall time that one block may take on a busy machine
PROGRAMS = ("octave-cli", "gcc", "node", "zenoh-ros2", "rostopic")
KINDS = (
    "bash run",
    "bash terminals",
    "bash elsewhere",
    *(f"bash with {program}" for program in PROGRAMS),
    "yaml",
    "yaml part",
    "yaml inventory",
    "python",
    "python run",
    "python test",
    "yaml github",
    "yaml gitlab",
    "text",
    "json",
)
ELSEWHERE = ("apt-get install ", "git clone ", "cd ", "python3 -m venv ", ".venv/bin/pip install ", ".venv/bin/jupyter ", "ssh ", "scp ",
             "rsync ", "sudo ", "zenohd ", "ufw ", "chrt ", "kill ", "docker ", "kubectl ", "sh ",
             ".venv/bin/pip wheel ", "export ", "make ", ".venv/bin/pytest ", ".venv/bin/python -m benchmarks",
             "python examples/", "unzip ", "mkdir ")  # fmt: skip


class Block(NamedTuple):
    """A fenced block; `chapter` is the number of headings before it."""

    kind: str
    text: str
    line: int
    chapter: int


def blocks(page: Path) -> Iterator[Block]:
    """Yield the fenced blocks of a page in order."""
    kind, first, chapter, inside = "", 0, 0, []
    for number, line in enumerate(page.read_text().splitlines(), start=1):
        if line.startswith("```"):
            if kind:
                yield Block(kind, "\n".join(inside), first, chapter)
                kind, inside = "", []
            else:
                kind, first = line[3:].strip() or "without a kind", number
        elif kind:
            inside.append(line)
        elif line.startswith("#"):
            chapter += 1


def pages_with(*kinds: str, long: tuple[str, ...] = ()) -> list[Any]:
    """Return, as parameters, the pages with a block of one of the kinds; those named in `long` are soak tests."""
    pages = [p for p in PAGES if any(b.kind in kinds for b in blocks(p))]
    return [pytest.param(p, id=p.name, marks=[pytest.mark.soak] if p.name in long else []) for p in pages]


def test_every_block_is_of_a_known_kind() -> None:
    unknown = [f"{page.name}:{b.line}: {b.kind}" for page in PAGES for b in blocks(page) if b.kind not in KINDS]
    assert unknown == []


# Commands


@pytest.mark.parametrize("page", pages_with("bash run", "bash terminals", long=LONG))
def test_commands_run(page: Path, tmp_path: Path) -> None:
    missing: list[str] = []
    with Checkout(tmp_path) as checkout:
        chapter = 0
        for block in blocks(page):
            if block.chapter != chapter:
                checkout.close_terminals()
                chapter = block.chapter
            program = block.kind.removeprefix("bash with ")
            if program != block.kind and not checkout.has(program):
                missing.append(program)
            elif block.kind == "bash run" or program != block.kind:
                checkout.run(block, page)
            elif block.kind == "bash terminals":
                checkout.open_terminals(block, page)
    if missing:
        pytest.skip(f"{page.name}: all but the blocks with {', '.join(missing)}, which this machine does not have")


@pytest.mark.parametrize("page", pages_with("python run"))
def test_python_runs(page: Path, tmp_path: Path, near: None) -> None:
    script = tmp_path / f"{page.stem}_page.py"
    script.write_text("\n\n".join(block.text for block in blocks(page) if block.kind == "python run"))
    with Checkout(tmp_path), chdir(tmp_path):
        run_path(str(script), run_name="__main__")


@pytest.mark.parametrize("page", pages_with("python test", long=LONG))
def test_pytest_blocks_pass(page: Path, tmp_path: Path, compiled: None) -> None:
    with Checkout(tmp_path) as checkout:
        for block in blocks(page):
            if block.kind == "python test":
                (tmp_path / "test_page.py").write_text(block.text)
                checkout.run(Block("bash run", "python -m pytest -p no:cacheprovider test_page.py", 1, 0), page)


@pytest.mark.parametrize("schema", ["github-workflows", "gitlab-ci"])
def test_ci_files_are_valid(schema: str, tmp_path: Path) -> None:
    kind = f"yaml {schema.partition('-')[0]}"
    found = [block for page in PAGES for block in blocks(page) if block.kind == kind]
    for block in found:
        (tmp_path / "ci.yml").write_text(block.text)
        command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", f"vendor.{schema}", "ci.yml"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
        (tmp_path / "ci.yml").write_text(block.text.replace("script:", "scripts:").replace("runs-on:", "runs:"))
        assert subprocess.run(command, cwd=tmp_path, capture_output=True, check=False).returncode != 0
    assert found


class Checkout:
    """A folder laid out like a fresh checkout, with free ports and the open terminals."""

    def __init__(self, folder: Path) -> None:
        for name in ("scenarios", "examples", "clients", "docs", "agents", "world", "zsim"):
            (folder / name).symlink_to(ROOT / name)
        (folder / ".venv").symlink_to(sys.prefix)
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self._environment = {**os.environ, "PATH": path, "COLUMNS": "100"}
        self._folder = folder
        self._ports = tuple(free_port() for _ in PORTS)
        self._terminals: list[tuple[str, Path, RoleProcess]] = []

    def __enter__(self) -> "Checkout":
        return self

    def __exit__(self, failed: object, *rest: object) -> None:
        try:
            if not failed:
                self.close_terminals()
        finally:
            for _, _, process in self._terminals:
                process.kill()
                process.wait()

    def has(self, program: str) -> bool:
        """Return whether a program is installed."""
        return shutil.which(program, path=self._environment["PATH"]) is not None

    def run(self, block: Block, page: Path) -> None:
        """Run the plain commands of a block in this process, other lines and blocks with a `$` as scripts."""
        where, whole = f"{page.name}:{block.line}", "$" in block.text
        all_lines = [adapted(line, self._ports, RUN_S) for line in lines(block)]
        for is_plain, some in groupby(all_lines, lambda line: not whole and PLAIN.fullmatch(line) is not None):
            if not is_plain:
                self._run_script("\n".join(some), where)
                continue
            for line in some:
                if steered := STEERED.search(line):
                    self._wait_for_flight(steered[1])
                with chdir(self._folder), pytest.MonkeyPatch.context() as patch:
                    patch.setattr(ReportFigure, "png", lambda _: PNG)  # the tests of reports draw figures
                    sweep_here(patch)
                    done = run_here(*shlex.split(line)[1:])
                assert done.code == 0, f"{where}: {line}\n{done}\n{self._logs()}"

    def _run_script(self, text: str, where: str) -> None:
        script = subprocess.Popen(
            ["bash", "-euo", "pipefail", "-c", text],
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            text=True,
        )
        try:
            output, _ = script.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            os.killpg(script.pid, signal.SIGKILL)
            output = f"{script.communicate()[0]}\nnot done after {PATIENCE_S} s"
        assert script.returncode == 0, f"{where}: {text}\n{output}\n{self._logs()}"

    def open_terminals(self, block: Block, page: Path) -> None:
        """Start each line of a block as a process; return once its world listens and its gateway serves."""
        for line in lines(block):
            text = adapted(line, self._ports, None)
            log = self._folder / f"terminal-{len(self._terminals)}-{time.monotonic_ns()}.log"
            words = shlex.split(text)
            with log.open("w") as out:
                forked = (
                    start_in(self._folder, words[1:], out) if words[0].removeprefix(".venv/bin/") == "zsim" else None
                )
                process = forked or subprocess.Popen(
                    ["bash", "-c", f"exec env {text}"],
                    cwd=self._folder,
                    env=self._environment,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=out,
                    start_new_session=True,
                )
            self._terminals.append((f"{page.name}:{block.line}: {text}", log, process))
        if re.search(r"\bzsim (run|world|replay) ", block.text):
            self._wait_for_port(self._ports[0])
        if "zsim gateway" in block.text:
            self._wait_for_run(self._ports[PORTS.index("8000")])

    def _wait_for_run(self, port: int) -> None:
        """Wait until a gateway has received a drone's estimate: by then every process has joined."""
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/json/drone/drone1/estimate"):
                return
            time.sleep(0.1)
        raise AssertionError(f"the gateway tells of no estimate\n{self._logs()}")

    def _wait_for_flight(self, drone: str) -> None:
        """Wait until a drone accepts setpoints: these commands come sooner than those that a reader types."""
        until_s, where = time.monotonic() + PATIENCE_S, f"tcp/127.0.0.1:{self._ports[0]}"
        while time.monotonic() < until_s:
            said = run_here("echo", f"drone/{drone}/sensor/status", "-n", "1", "--connect", where).stdout
            if re.search("hovering|flying", said):
                return
        raise AssertionError(f"{drone} does not fly\n{self._logs()}")

    def _wait_for_port(self, port: int) -> None:
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return
            time.sleep(0.05)
        raise AssertionError(f"nobody listens\n{self._logs()}")

    def close_terminals(self) -> None:
        """Send Ctrl-C to the processes in LEADERS; they, and the others by themselves, must exit cleanly."""
        for text, _, process in self._terminals:
            if process.poll() is None and re.search(LEADERS, text):
                os.kill(process.pid, signal.SIGINT)
        for text, _, process in self._terminals:
            code = process.wait(timeout=PATIENCE_S)
            # −2 (SIGINT): Ctrl-C arrived while Python was shutting down
            assert code in (0, 130, -signal.SIGINT), f"{text}: exit code {code}\n{self._logs()}"
        self._terminals.clear()

    def _logs(self) -> str:
        return "\n".join(f"--- {text}\n{log.read_text()}" for text, log, _ in self._terminals)


def lines(block: Block) -> list[str]:
    """Return the commands of a block, without comments and with continued lines joined."""
    joined = re.sub(r"\\\n\s*", "", block.text)
    stripped = [re.sub(r"(^|\s)#.*$", "", line).rstrip() for line in joined.splitlines()]
    return [line for line in stripped if line]


EXAMPLE_S = 25.0  # simulated duration of an example: past the take-off at 20 s
PORTS = ("7447", "7448", "8000", "7470", "11311")  # printed ports of the world, router, HTTP, JSON lines and ROS master
LEADERS = r"zsim (run|world|replay|router|gateway|ros1|ros2|camera|detect)\b"
ANSWERED = ("agent", "estimator", "fmu", "controller", "host", "record", "keys", "echo", "hz", "pub", "ask", "gateway", "ros1", "ros2", "camera", "detect",
            "fault (?:add|clear|list)")  # fmt: skip
FOREIGN = (
    "plain_client.py",
    "foreign_estimator.py",
    "range_sensor.py",
    "external_drone.py",
)  # programs that take the endpoint as a positional argument
OURS = ("fly_square.py",)
STEERED = re.compile(r"zsim pub .*\bdrone/(\w+)/cmd/velocity")
PLAIN = re.compile(
    r"zsim (validate|keys|echo|hz|ask|pub|fault|report|export|bundle|rerun|sweep(?!.*--dask)|run .*--in-process) [^|<>;&]*"
)


def adapted(line: str, ports: tuple[int, ...], longest_s: float | None) -> str:
    """Return a command with this test's endpoints, and with a duration of longest_s if that is given."""
    endpoint = f"tcp/127.0.0.1:{ports[0]}"
    own = "7447" in line
    line = re.sub(r"\bzsim gateway\b", "zsim gateway --http 8000 --lines 7470", line.replace("0.0.0.0", "127.0.0.1"))
    for printed, port in zip(PORTS, ports, strict=True):
        line = re.sub(rf"\b{printed}\b", str(port), line)
    line = re.sub(r"\bzsim (run)\b(?!.*--in-process)", rf"zsim \1 --listen {endpoint}", line)
    if longest_s is not None and re.search(r"\bzsim run\b", line):
        line = re.sub(r"--duration \S+", "", line).replace("zsim run", f"zsim run --duration {longest_s:g}")
    line = re.sub(r"(\bzsim sweep\b.* --duration) \S+", rf"\1 {RUN_S:g}", line)
    line = re.sub(r"\bzsim sweep\b(?=.* --out )", "zsim sweep --no-report", line)
    line = re.sub(r"(examples/.* --duration) (\S+)", lambda m: f"{m[1]} {min(float(m[2]), EXAMPLE_S):g}", line)
    if " --out " not in line:
        line = re.sub(r"\bzsim run\b", "zsim run --no-report", line)
    line = re.sub(r"--realtime\b", "--realtime --rate 2", line)
    if not own:
        line = re.sub(r"\bzsim (world|replay)\b", rf"zsim \1 --listen {endpoint}", line)
        line = re.sub(rf"\bzsim ({'|'.join(ANSWERED)})\b", rf"zsim \1 --connect {endpoint}", line)
        line = re.sub(rf"({'|'.join(map(re.escape, FOREIGN))})", rf"\1 {endpoint}", line)
        line = re.sub(rf"({'|'.join(map(re.escape, OURS))})", rf"\1 --connect {endpoint}", line)
    line = re.sub(r"\bzsim (keys|echo|hz|pub|ask|fault (?:add|clear|list))\b", rf"zsim \1 --wait {PATIENCE_S}", line)
    return re.sub(r"\bmake (\w+)", rf"make -n -C {ROOT} \1 >/dev/null", line)  # last: ROOT may end with zsim


def lines_of(*kinds: str) -> Iterator[tuple[str, str]]:
    """Yield the place and the text of every command in blocks of the given kinds, on all pages."""
    for page in PAGES:
        for block in blocks(page):
            for line in lines(block) if block.kind in kinds else ():
                yield f"{page.name}:{block.line}: {line}", line


def test_every_printed_command_is_valid() -> None:
    for where, line in lines_of("bash run", "bash terminals"):
        words = [word for word in shlex.split(line) if not re.match(r"[A-Z_]+=", word)]
        if words[:1] == ["zsim"]:
            ends = [place for place, word in enumerate(words) if word in ("|", ">", "&&", "||", "&")]
            assert parses(words[1 : min(ends, default=len(words))]), where
    for where, line in lines_of("bash elsewhere"):
        if re.match(r"(\S*/)?zsim ", line):
            assert parses(shlex.split(line)[1:]), where
        else:
            assert line.startswith(ELSEWHERE), f"{where}: add its command to ELSEWHERE"


def parses(arguments: list[str]) -> bool:
    """Return True if the command line accepts the arguments, and raise otherwise; nothing is run."""
    command, name, rest = commands()[arguments[0]], arguments[0], arguments[1:]
    while hasattr(command, "commands"):
        command, name, rest = command.commands[rest[0]], rest[0], rest[1:]
    with command.make_context(name, rest):
        return True


@cache
def commands() -> dict[str, Any]:
    """Return the commands of `zsim` by name."""
    return typer.main.get_command(app).commands  # type: ignore[attr-defined]


NOT_IN_DEV = {"train_policy.py"}  # run by test_learning.py: it needs an extra that `dev` does not include


def test_every_example_is_run_by_a_page() -> None:
    run = "\n".join(b.text for p in PAGES for b in blocks(p) if b.kind in ("bash run", "bash terminals"))
    examples = sorted((ROOT / "examples").glob("*.*"))
    named = set(re.findall(r"[=: ](\w+)", run))  # run as modules
    left_out = [e.name for e in examples if f"examples/{e.name}" not in run and e.stem not in named]
    assert set(left_out) == NOT_IN_DEV


def test_every_command_is_shown_on_a_page() -> None:
    shown = "\n".join(b.text for p in PAGES for b in blocks(p) if b.kind.startswith("bash"))
    assert [name for name in commands() if f"zsim {name}" not in shown] == []


# Scenarios


def test_inventories_are_valid(tmp_path: Path) -> None:
    step = scenario_file.load(ROOT / "scenarios/step.yaml")
    found = [block for page in PAGES for block in blocks(page) if block.kind == "yaml inventory"]
    for block in found:
        (tmp_path / "hosts.yaml").write_text(block.text)
        assert inventory.placement(inventory.load(tmp_path / "hosts.yaml"), step)
    assert found


@pytest.mark.parametrize("page", pages_with("yaml", "yaml part"))
def test_scenarios_are_valid(page: Path) -> None:
    from zsim.contract.messages import Info
    from zsim_agents.formation.controller import Controller

    for block in blocks(page):
        if block.kind in ("yaml", "yaml part"):
            given = yaml.safe_load(block.text)
            base = yaml.safe_load((ROOT / "scenarios/step.yaml").read_text()) if block.kind == "yaml part" else {}
            resolved = scenario_file.resolve({**base, **given})
            info = msgspec.convert({**_INFO, "seed": resolved.seed}, Info)
            for cluster in resolved.clusters:
                Controller(info, resolved, cluster.name)  # checks the names and expressions of the plan


_INFO: dict[str, Any] = {
    "t_ns": 0,
    "seq": 0,
    "contract": 1,
    "run_id": "docs",
    "federation": "zsim",
    "mode": "lockstep",
    "rate": 0.0,
    "gate_ns": 20_000_000,
    "physics_dt_ns": 2_500_000,
    "command_delay_ns": 20_000_000,
    "origin": {"latitude_deg": 0.0, "longitude_deg": 0.0, "height_m": 0.0},
    "drones": [],
    "clusters": [],
    "scenario": "",
    "scenario_sha256": "",
    "version": "",
    "fingerprint": "",
}


# The field reference: a table after `<!-- fields: Name -->` for each section of zsim/scenario/scenario.py

SCANNER_SECTIONS = (RangeConfig, LidarConfig, DepthConfig)
CAMERA_SECTIONS = (FrontCamera, BottomCamera, SightingModel, Hats)
SECTIONS = {
    name: section
    for name, section in {**vars(scenario), "Limits": vehicle.Limits, "Aerodynamics": vehicle.Aerodynamics}.items()
    if isinstance(section, type)
    and issubclass(section, (scenario.Spec, vehicle.Limits, vehicle.Aerodynamics))
    and section not in (scenario.Spec, scenario.Piloted)  # base classes
} | {
    section.__name__: section
    for section in (
        Sensors,
        Sensor,
        Mount,
        ErrorModel,
        *CAMERA_SECTIONS,
        *SCANNER_SECTIONS,
        *(kind.settings for kind in STOCK.values()),
    )
}
UNITS = {
    "_kg_m2": "kg m²", "_kg_m3": "kg/m³", "_n_s_m": "N s/m", "_n_s2_m2": "N s²/m²", "_n_s2_m": "N s²/m", "_nm_s2": "N m s²", "_n_s2": "N s²", "_1_s2": "1/s²",
    "_1_s": "1/s", "_rad_s": "rad/s", "_deg_s": "deg/s", "_m_s2": "m/s²", "_m_s": "m/s", "_deg": "deg", "_mah": "mAh",
    "_percent": "%", "_kg": "kg", "_hz": "Hz", "_ms": "ms", "_ut": "µT", "_px2": "px²", "_px": "px", "_1_m": "1/m",
    "_kbit_s": "kbit/s", "_m": "m", "_s": "s",
}  # fmt: skip
OWN_UNITS = {
    "noise": "channel's", "density": "channel's/√Hz", "bias": "channel's", "bias_walk": "channel's/√s",
    "bias_instability": "channel's", "quantum": "channel's", "madgwick_beta": "rad/s", "values": "m, rad", "target": "m, rad",
}  # fmt: skip
FILLED_IN = {("Sensors", "own"), ("OwnAgent", "declared"), ("Surface", "triangles")}  # set by the code, never by a file
BY_PRESET = {"rate_hz", "imu", "gps", "mag", "baro", "sonar", "flow"}  # required once the preset is applied


def reference() -> dict[str, list[list[str]]]:
    """Return the rows of every field table in docs/scenario.md, by section."""
    text = (ROOT / "docs/scenario.md").read_text()
    tables = re.findall(r"<!-- fields: (\w+) -->\n\n?((?:\|.*\n)+)", text)
    return {
        name: [[cell.strip() for cell in row.strip("|").split("|")] for row in body.splitlines()[2:]]
        for name, body in tables
    }


def test_every_scenario_section_has_a_table() -> None:
    assert sorted(reference()) == sorted(set(SECTIONS) - {"Document"})


def test_the_field_tables_match_the_code() -> None:
    written = reference()
    assert {name: [row[:4] for row in table] for name, table in written.items()} == {
        name: list(rows(name)) for name in written
    }
    assert all(row[4] for table in written.values() for row in table), "a field without a word about it"


def rows(name: str) -> Iterator[list[str]]:
    """Yield the field, unit, default and limits of every entry of a section, as the reference must show them."""
    section = SECTIONS[name]
    inherited = {f.name for f in msgspec.structs.fields(Sensor)} if name in _SENSORS else set()
    infos = types.type_info(section)
    assert isinstance(infos, types.StructType)
    by_name = {f.name: f.type for f in infos.fields}
    for entry in msgspec.structs.fields(section):
        if entry.name not in inherited and (name, entry.name) not in FILLED_IN:
            yield [f"`{entry.encode_name}`", unit(entry.name), default(name, entry), allowed(by_name[entry.name])]


_SENSORS = tuple(kind.__name__ for kind in (*(kind.settings for kind in STOCK.values()), *SCANNER_SECTIONS))


def unit(name: str) -> str:
    found = [text for suffix, text in UNITS.items() if name.endswith(suffix)]
    return OWN_UNITS.get(name) or (found[0] if found else "–")


def default(section: str, entry: Any) -> str:
    if entry.default is msgspec.NODEFAULT and entry.default_factory is msgspec.NODEFAULT:
        return _required(section, entry.name)
    if entry.default is msgspec.UNSET:
        return "left out"
    value = entry.default_factory() if entry.default is msgspec.NODEFAULT else entry.default
    if value is msgspec.UNSET:
        return "–"
    return "see section" if isinstance(value, msgspec.Struct) else f"`{shown(value)}`"


def _required(section: str, name: str) -> str:
    if section == "Sensors" and name == "preset":
        return "`ardrone2`"
    if section in ("Sensor", "Sensors") and name in BY_PRESET:
        return "from the preset"
    return "from the scenario" if (section, name) == ("Drone", "sensors") else "required"


def shown(value: Any) -> str:
    """Return a value as YAML writes it in one line."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(shown, value))}]"
    if isinstance(value, bool) or value is None or isinstance(value, dict):
        return {None: "null", True: "true", False: "false"}.get(value) if not isinstance(value, dict) else "{}"  # type: ignore[return-value]
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def allowed(info: types.Type) -> str:
    """Return the limits of a type in words."""
    if isinstance(info, types.Metadata):
        return f"{(info.extra_json_schema or {})['description']}"
    if isinstance(info, types.UnionType):
        options = [t for t in info.types if not isinstance(t, types.NoneType)]
        return ", ".join([*map(allowed, options), "`null`"])
    if isinstance(info, types.FloatType | types.IntType):
        return _number(info)
    if isinstance(info, types.TupleType):
        return f"{len(info.item_types)} of: {allowed(info.item_types[0])}"
    if isinstance(info, types.ListType):
        return f"list of: {allowed(info.item_type)}{_length(info)}"
    if isinstance(info, types.DictType):
        return f"map of: {allowed(info.value_type)}{_length(info)}"
    if isinstance(info, types.StructType):
        return f"[{info.cls.__name__}](#{info.cls.__name__.lower()})"
    if isinstance(info, types.LiteralType):
        return ", ".join(f"`{value}`" for value in info.values)
    if isinstance(info, types.AnyType):
        return "anything"
    if isinstance(info, types.StrType):
        return "name" if info.pattern else "text"
    assert isinstance(info, types.BoolType)
    return "`true`, `false`"


def _number(info: types.FloatType | types.IntType) -> str:
    whole, large = isinstance(info, types.IntType), quantities.LARGE
    low, least = (info.gt, ">") if info.ge is None else (info.ge, "≥")
    high, most = (info.lt, "<") if info.le is None else (info.le, "≤")
    limits = [f"{least} {low:g}"] if low is not None and abs(low) < large else []
    if high is not None and (abs(high) < large or whole):
        limits.append(f"{most} {'2^62' if high == 2**62 else f'{high:.0f}' if high >= 1e4 else f'{high:g}'}")
    return f"{'whole number' if whole else 'number'} {', '.join(limits)}".rstrip()


def _length(info: types.ListType | types.DictType) -> str:
    least = f", at least {info.min_length}" if info.min_length else ""
    return least + (f", at most {info.max_length}" if info.max_length else "")


def test_the_preset_table_matches_the_code() -> None:
    text = (ROOT / "docs/scenario.md").read_text()
    table = re.search(r"<!-- presets -->\n\n?((?:\|.*\n)+)", text)
    assert table
    written = [[cell.strip() for cell in row.strip("|").split("|")] for row in table[1].splitlines()[2:]]
    assert written == list(preset_rows())


def preset_rows() -> Iterator[list[str]]:
    """Yield a row for each value that a preset sets: its path, then its value in each preset (– for the default)."""
    flat = {name: dict(_flat(preset)) for name, preset in PRESETS.items()}
    printed = dict(_flat(AS_PRINTED))
    paths = list(dict.fromkeys(path for values in flat.values() for path in values))
    for path in paths:
        cells = [f"{flat[name][path]:g}" if path in flat[name] else "–" for name in ("ardrone2", "paper", "crazyflie2")]
        if path in printed:
            cells[1] += f" (`as_printed`: {printed[path]:.4g})"
        yield [f"`{path}`", *cells]


def _flat(value: dict[str, Any], path: str = "") -> Iterator[tuple[str, float]]:
    for name, item in value.items():
        if isinstance(item, dict):
            yield from _flat(item, f"{path}{name}.")
        else:
            yield f"{path}{name}", item


# The protocol


def protocol_row(shape: str) -> str:
    """Return the row of a key in the table of docs/protocol.md."""
    things = {"drone/*": "drone/{d}", "cluster/*": "cluster/{c}", "process/*": "process/{p}"}
    key = shape.replace("estimates/*", "estimates/{p}")
    things |= {f"camera/{camera}": "camera/{name}" for camera in CAMERAS}
    for stars, names in things.items():
        key = key.replace(stars, names)
    text = (ROOT / "docs/protocol.md").read_text()
    return next(line for line in text.splitlines() if line.startswith(f"| `{key}` |"))


def test_the_protocol_names_every_message_its_fields_and_a_writer() -> None:
    """The row of a key names the message, all its fields, including nested ones, and a publisher."""
    lacking = {}
    for shape, kind in messages.types_by_shape().items():
        row, writers = protocol_row(shape), messages.TOPICS[shape].writers if shape in messages.TOPICS else ()
        wanted = [kind.__name__, *(f for f in messages.fields(kind) if f not in ("t_ns", "seq"))]
        lacking[shape] = [word for word in wanted if not re.search(rf"\b{word}\b", row)]
        words = [word for role in writers for word in (("each", "participant") if role == "each" else (role,))]
        if writers and not any(word in row.split("|")[2] for word in words):
            lacking[shape].append(f"a writer of {words}")
    assert {shape: words for shape, words in lacking.items() if words} == {}


def test_the_protocol_names_every_event() -> None:
    code = "".join(path.read_text() for path in sorted((ROOT / "world/zsim_world").rglob("*.py")))
    kinds = set(re.findall(r"\b(?:event|notice|Incident)\((?:i, )?\s*\"(\w+)\"", code))
    assert kinds <= {*EVENT_KINDS}
    assert [kind for kind in EVENT_KINDS if f'"{kind}' not in code] == []
    section = (ROOT / "docs/protocol.md").read_text().partition("\n## Events\n")[2].partition("Endless repetitions")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    assert sorted(kind for row in rows for kind in re.findall(r"`(\w+)`", row)) == sorted(EVENT_KINDS)


# Links, files and names


def test_link_targets_exist() -> None:
    """Links to files and headings exist; a link whose text is a name in code leads to a file that defines it."""
    faults = []
    for page in PAGES:
        prose = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        pictures = [("", source) for source in re.findall(r'<img src="([^"]+)"', prose)]
        for text, link in [*re.findall(r"!?\[([^\]]*)\]\(([^)\s]+)\)", prose), *pictures]:
            if re.match(r"[a-z]+:", link):
                continue
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            if not target.exists():
                faults.append(f"{page.name}: {link}: no such file")
            elif anchor and anchor not in anchors(target):
                faults.append(f"{page.name}: {link}: no such heading")
            elif target.suffix == ".py" and text.startswith("`") and not defines(target, text.strip("`")):
                faults.append(f"{page.name}: {link}: does not define {text}")
    assert faults == []


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub generates them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def defines(file: Path, name: str) -> bool:
    """Return whether a file defines the last part of a dotted name; the file's own path counts."""
    last = name.removesuffix("()").rsplit(".", 1)[-1]
    definition = re.compile(rf"^\s*(class|def) {last}\b|^{last}\b.*=", re.MULTILINE)
    return str(file).endswith(name) or definition.search(file.read_text()) is not None


FOLDERS = "zsim|world|agents|deploy|examples|scenarios|docs|tests|benchmarks"


def test_named_files_exist() -> None:
    named = {name for page in PAGES for name in re.findall(rf"`((?:{FOLDERS})/[\w/.-]+\.\w+)`", page.read_text())}
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []


def test_python_compiles() -> None:
    for page in PAGES:
        for block in blocks(page):
            if block.kind == "python":
                compile(block.text, f"{page.name}:{block.line}", "exec")


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150
