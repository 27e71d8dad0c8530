"""Without extras, each command reports in one line which of them it needs."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

from refused import has_terms
from synthetic_record import SCENARIOS, Flown, write

from zsim.errors import EXTRA_OF, install_command

ROOT = Path(__file__).parents[2]
STEP = str(SCENARIOS / "step.yaml")
BARE = """
import json, os, sys
from importlib.machinery import PathFinder

hidden, folder, commands = json.loads(sys.argv[1])

class Finder(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if path is None and name in hidden else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Finder
import zsim.scenario.scenario_file
from zsim_deploy.cli.cli import command, main

command().commands["console"].make_context("console", [], resilient_parsing=True)  # once: it imports much
for number, words in enumerate(commands):
    if not (pid := os.fork()):
        for stream in (1, 2):
            os.dup2(os.open(f"{folder}/{number}.{stream}", os.O_WRONLY | os.O_CREAT), stream)
        sys.argv = ["zsim", *words]
        main()
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""
INVENTORY = "hosts: {a: {address: 127.0.0.1}}\nroles: {world: a, recorder: a, 'estimator.*': a, 'controller.*': a}\n"
# command, extras that it must report; {run}: folder of a run, {hosts}: an inventory, {new}: a missing folder
COMMANDS = [
    (["run", STEP, "--out", "{new}"], "agents,report,world"),
    (["run", STEP, "--out", "{new}", "--in-process", "--no-report"], "agents,record,world"),
    (["up", STEP, "--hosts", "{hosts}", "--out", "{new}"], "hosts,report"),
    (["world", STEP], "agents"),
    (["estimator", "drone1"], "agents"),
    (["record", "--out", "{new}"], "record"),
    (["replay", "{run}"], "record"),
    (["report", "{run}"], "report"),
    (["rerun", "{run}"], "agents,record,world"),
    (["export", "{run}", "--format", "csv"], "export"),
    (["export", "{run}", "--format", "parquet"], "export"),
    (["export", "{run}", "--format", "mat"], "export"),
    (["export", "{run}", "--format", "foxglove"], "export"),
    (["sweep", STEP, "--runs", "2", "--out", "{new}"], "sweep"),
    (["board", "--seeds", "1", "--out", "{new}"], "sweep"),
    (["console"], "console"),
    (["gateway"], "gateway"),
    (["ros1"], "ros1"),
    (["ros2"], "ros2"),
    (["fmu", "controller.fmu"], "fmu"),
    (["camera", "drone1"], "cameras"),
    (["detect", "drone1"], "cameras"),
    (["push", "--hosts", "{hosts}"], "hosts"),
    (["doctor", "--hosts", "{hosts}"], "hosts"),
    (["certs", "init", "{hosts}", "--scenario", STEP], "hosts"),
]


def test_a_command_without_its_extra_says_how_to_install_it(tmp_path: Path) -> None:
    """Each command is forked from one Python that finds none of the packages of the extras."""
    (tmp_path / "hosts.yaml").write_text(INVENTORY)
    (tmp_path / "run").mkdir()
    write(tmp_path / "run" / "run.mcap", Flown())
    new = tmp_path / "new"
    places = {"{run}": str(tmp_path / "run"), "{hosts}": str(tmp_path / "hosts.yaml"), "{new}": str(new)}
    commands = [[places.get(word, word) for word in words] for words, _ in COMMANDS]
    given = json.dumps([[*EXTRA_OF], str(tmp_path), commands])
    done = subprocess.run([sys.executable, "-c", BARE, given], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    codes = list(map(int, done.stdout.split()))
    for number, ((words, extra), code) in enumerate(zip(COMMANDS, codes, strict=True)):
        printed = (tmp_path / f"{number}.2").read_text()
        assert (code, len(printed.splitlines())) == (2, 1), (words, printed)
        assert has_terms(printed, install_command(extra.split(","))), words
    assert not new.exists()


def test_every_optional_module_belongs_to_a_known_extra() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(EXTRA_OF.values()) <= set(extras)
