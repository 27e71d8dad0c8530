"""The reference of zsim's Python interface has every public name with its docstring and builds without warnings."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import zsim
import zsim_api

DOCS = Path(__file__).parents[3] / "docs/api"
pytestmark = pytest.mark.skipif(not importlib.util.find_spec("furo"), reason="the extra `docs` is not installed")


def test_the_reference_builds_without_warnings_and_has_every_name(tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-m", "sphinx", "-W", "--keep-going", "-q", str(DOCS), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = "".join(page.read_text() for page in tmp_path.glob("*.html"))
    documented = re.findall(r'<dt [^>]*id="zsim\.(\w+)"', pages)
    assert sorted(documented) == sorted(zsim_api.__all__)
    assert {"zsim.Run.truth", "zsim.Simulation.step"} <= {*re.findall(r'<dt [^>]*id="([\w.]+)"', pages)}
    assert "(" not in "".join(re.findall(r"<strong>(.*?)</strong>", pages))  # all names of arguments were parsed


class Silence:
    """A logger that keeps warnings."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def warning(self, text: str) -> None:
        self.lines.append(text)


@pytest.fixture
def conf(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return Sphinx's configuration module, with a logger that keeps warnings."""
    spec = importlib.util.spec_from_file_location("reference_conf", DOCS / "conf.py")
    assert spec is not None
    assert spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "LOGGER", Silence())
    return module


def fresh(number: int) -> int:
    return number


class Fresh:
    """A class with a method without a docstring."""

    def step(self) -> None:
        pass

    def _own(self) -> None:
        pass


def test_a_new_name_is_documented_and_must_have_a_docstring(conf: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zsim_api, "_WHERE", {**zsim_api._WHERE, "zsim_api.brand_new": ("fresh", "Fresh")})
    monkeypatch.setattr(zsim_api, "_MODULES", {**zsim_api._MODULES, "fresh": __name__, "Fresh": __name__})
    for made in (fresh, Fresh):
        monkeypatch.setattr(zsim, made.__name__, made, raising=False)
    assert conf.names_of("flights")[-2:] == ["fresh", "Fresh"]
    assert {name for page in conf.PAGES for name in conf.names_of(page)} == {*zsim_api._MODULES}
    assert list(conf.directive("run")) == [".. autofunction:: zsim.run", ""]
    assert conf.LOGGER.lines == []
    assert next(conf.directive("fresh")) == ".. autofunction:: zsim.fresh"
    assert next(conf.directive("Fresh")) == ".. autoclass:: zsim.Fresh"
    assert [line.split(",")[0] for line in conf.LOGGER.lines] == ["zsim.fresh", "zsim.Fresh.step"]
