"""Classes and modules of a user's own package, named in a document."""

import subprocess
import sys
from pathlib import Path
from typing import Any, Protocol

import pytest
from refused import has_terms

from zsim.errors import DocumentError
from zsim.schema import plugin


class Meter(Protocol):
    """What a class is to be."""

    def read(self) -> float: ...
    def reset(self) -> None: ...


SOURCE = """
class Good:
    def read(self): return 1.0
    def reset(self): pass

class Half:
    def read(self): return 1.0

class Narrow(Good):
    def read(self, scale): return scale

class Wide(Good):
    def read(self, *more, scale=1.0): return scale

def measure(): return 2.0

number = 3
"""


@pytest.fixture
def beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with modules that is searched."""
    monkeypatch.setenv(plugin.FOLDERS, "")
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "plugin_meter.py").write_text(SOURCE)
    (tmp_path / "plugin_broken.py").write_text("1 / 0\n")
    (tmp_path / "plugin_exits.py").write_text("raise SystemExit\n")
    plugin.search(tmp_path)
    return tmp_path


def test_a_method_may_take_more_than_it_is_given(beside: Path) -> None:
    assert plugin.load("plugin_meter:Wide", "a.yaml: meter", Meter)().read() == 1.0


@pytest.mark.parametrize("returned", [None, "1", ["1"], [None, 1.0], 1j, [[1.0], [1.0, 2.0]], object()])
def test_what_is_no_real_numbers_is_refused(returned: Any) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - whose text is not shown
        plugin.numbers(returned)


def test_a_class_is_loaded_from_beside_the_document(beside: Path) -> None:
    assert plugin.load("plugin_meter:Good", "a.yaml: meter", Meter)().read() == 1.0


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("plugin_nowhere:Good", "ModuleNotFoundError"),
        ("plugin_broken:Good", "ZeroDivisionError"),
        ("plugin_exits:Good", "SystemExit"),
        ("plugin_meter:Narrow", "scale"),
        ("plugin_meter:Bad", "Good, Half, Narrow, Wide"),
        ("plugin_meter:number", "Good, Half, Narrow, Wide"),
        ("plugin_meter:Half", "reset"),
        ("plugin_meter", "package.module:Class"),
        (":Good", "package.module:Class"),
    ],
)
def test_what_cannot_be_loaded_is_one_line(beside: Path, name: str, wrong: str) -> None:
    with pytest.raises(DocumentError) as raised:
        plugin.load(name, "a.yaml: meter", Meter)
    (line,) = raised.value.faults
    assert has_terms(line, "a.yaml", "meter")
    assert wrong in line
    assert "\n" not in line


def test_a_function_is_loaded(beside: Path) -> None:
    assert plugin.load_function("plugin_meter:measure", "a.yaml: metrics")() == 2.0


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("plugin_nowhere:measure", "ModuleNotFoundError"),
        ("plugin_meter:bad", "measure"),
        ("plugin_meter:number", "measure"),
        ("plugin_meter", "package.module:function"),
    ],
)
def test_what_is_no_function_is_one_line(beside: Path, name: str, wrong: str) -> None:
    with pytest.raises(DocumentError) as raised:
        plugin.load_function(name, "a.yaml: metrics")
    (line,) = raised.value.faults
    assert has_terms(line, "a.yaml", "metrics")
    assert wrong in line


def test_a_module_is_loaded(beside: Path) -> None:
    assert plugin.load_module("plugin_meter", "a.yaml: module").number == 3


def test_processes_started_from_here_search_there_too(beside: Path) -> None:
    code = "from zsim.schema import plugin; print(plugin.load_module('plugin_meter', '').number)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "3\n"


def test_a_folder_is_named_once_and_hides_nothing(beside: Path) -> None:
    (beside / "json.py").write_text("")
    plugin.search(beside)
    assert plugin.load_module("json", "").__file__ != str(beside / "json.py")
    plugin.load_module("plugin_meter", "")
    assert sys.path.count(str(beside)) == 1
