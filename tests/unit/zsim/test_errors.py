"""Extras are documented as installed from a checkout, since no index has the distribution."""

import re
import tomllib
from pathlib import Path

from zsim.errors import install_command

ROOT = Path(__file__).parents[3]
WRITTEN = ("README.md", "docs/**/*.md", "deploy/**/*.py", "agents/**/*.py", "world/**/*.py", "zsim/**/*.py")
WRITTEN += ("examples/**/*", "clients/**/*", "scenarios/*", "benchmarks/**/*.py", "tests/**/*.py")
OF_AN_INDEX = re.compile(r"zsim\[[a-z{]")  # zsim[gateway], zsim[{extra}]
OF_A_CHECKOUT = re.compile(r"pip install (?:-e )?'\.\[([a-z0-9,]+)\]'")


def texts() -> dict[str, str]:
    files = {path for pattern in WRITTEN for path in ROOT.glob(pattern) if path.is_file()} - {Path(__file__)}
    return {str(path.relative_to(ROOT)): path.read_text(errors="replace") for path in sorted(files)}


def test_no_text_installs_zsim_from_an_index() -> None:
    assert [place for place, text in texts().items() if OF_AN_INDEX.search(text)] == []


def test_every_extra_that_a_text_installs_exists() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = [name for text in texts().values() for names in OF_A_CHECKOUT.findall(text) for name in names.split(",")]
    assert "notebook" in named
    assert set(named) <= set(extras)


def test_the_command_names_each_extra_once() -> None:
    assert "[agents,world]'" in install_command(["world", "agents", "world"])
