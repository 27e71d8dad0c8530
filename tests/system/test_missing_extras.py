"""What a person types who has installed zsim without extras: each command says which one it needs, in a line."""

import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from refused import has_terms
from synthetic_record import SCENARIOS, Flown, write

from zsim.errors import EXTRA_OF, install_command

ROOT = Path(__file__).parents[2]
STEP = str(SCENARIOS / "step.yaml")
HIDES = """
import os, sys
from importlib.machinery import PathFinder

HIDDEN = set(os.environ["HIDDEN"].split())

class Finder(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if path is None and name in HIDDEN else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Finder
"""
INVENTORY = "hosts: {a: {address: 127.0.0.1}}\nroles: {world: a, recorder: a, 'estimator.*': a, 'controller.*': a}\n"
# command, and extras that it names; {run} is the folder of a run, {hosts} an inventory, {new} a folder that is not there
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
    (["console"], "console"),
    (["gateway"], "gateway"),
    (["ros1"], "ros1"),
    (["ros2"], "ros2"),
    (["camera", "drone1"], "cameras"),
    (["detect", "drone1"], "cameras"),
    (["push", "--hosts", "{hosts}"], "hosts"),
    (["doctor", "--hosts", "{hosts}"], "hosts"),
    (["certs", "init", "{hosts}", "--scenario", STEP], "hosts"),
]


@pytest.fixture
def bare(tmp_path: Path) -> Callable[[list[str]], subprocess.CompletedProcess[str]]:
    """Return how a command is run without any package that an extra brings."""
    (tmp_path / "hidden").mkdir()
    (tmp_path / "hidden" / "sitecustomize.py").write_text(HIDES)
    (tmp_path / "hosts.yaml").write_text(INVENTORY)
    (tmp_path / "run").mkdir()
    write(tmp_path / "run" / "run.mcap", Flown())
    places = {"{run}": str(tmp_path / "run"), "{hosts}": str(tmp_path / "hosts.yaml"), "{new}": str(tmp_path / "new")}
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "hidden"), "HIDDEN": " ".join(EXTRA_OF)}

    def run(words: list[str]) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "zsim_deploy.cli", *(places.get(word, word) for word in words)]
        return subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)

    return run


@pytest.mark.parametrize(("words", "extra"), COMMANDS, ids=[" ".join(words[:1] + words[-1:]) for words, _ in COMMANDS])
def test_a_command_without_its_extra_says_what_to_type(
    bare: Callable[[list[str]], subprocess.CompletedProcess[str]], tmp_path: Path, words: list[str], extra: str
) -> None:
    done = bare(words)
    lines = done.stderr.splitlines()
    assert (done.returncode, len(lines)) == (2, 1), done.stderr
    assert has_terms(lines[0], install_command(extra.split(",")))
    assert not (tmp_path / "new").exists()


def test_each_module_is_of_an_extra() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(EXTRA_OF.values()) <= set(extras)
