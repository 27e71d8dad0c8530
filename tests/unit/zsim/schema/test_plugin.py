"""Classes, functions and modules of a user's own package, named in a document."""

import subprocess
import sys
from pathlib import Path
from typing import Any, Protocol

import pytest
from refused import has_terms

from zsim.errors import DocumentError, NotTrustedError
from zsim.schema import plugin


class Meter(Protocol):
    """The protocol that a loaded class must implement."""

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
    """A folder with modules that is searched; its name contains characters that separate paths on some systems."""
    monkeypatch.setenv(plugin.FOLDERS, "")
    monkeypatch.setattr(sys, "path", [*sys.path])
    folder = tmp_path / "12:30 ü;"  # like that of a run named after its time
    folder.mkdir()
    (folder / "plugin_meter.py").write_text(SOURCE)
    (folder / "plugin_broken.py").write_text("1 / 0\n")
    (folder / "plugin_exits.py").write_text("raise SystemExit\n")
    plugin.search(folder)
    return folder


def test_a_method_may_have_additional_optional_parameters(beside: Path) -> None:
    assert plugin.load("plugin_meter:Wide", "a.yaml: meter", Meter)().read() == 1.0


@pytest.mark.parametrize("returned", [None, "1", ["1"], [None, 1.0], 1j, [[1.0], [1.0, 2.0]], object()])
def test_values_that_are_not_real_numbers_are_refused(returned: Any) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - its text is never shown
        plugin.numbers(returned)


def test_a_class_is_loaded_from_the_folder_of_the_document(beside: Path) -> None:
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
def test_a_class_that_cannot_be_loaded_is_reported_in_one_line(beside: Path, name: str, wrong: str) -> None:
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
def test_an_invalid_function_is_reported_in_one_line(beside: Path, name: str, wrong: str) -> None:
    with pytest.raises(DocumentError) as raised:
        plugin.load_function(name, "a.yaml: metrics")
    (line,) = raised.value.faults
    assert has_terms(line, "a.yaml", "metrics")
    assert wrong in line


def test_a_module_is_loaded(beside: Path) -> None:
    assert plugin.load_module("plugin_meter", "a.yaml: module").number == 3


def test_child_processes_search_the_same_folders(beside: Path) -> None:
    code = "from zsim.schema import plugin; print(plugin.load_module('plugin_meter', '').number)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "3\n"


def test_a_folder_is_added_once_and_shadows_no_module(beside: Path) -> None:
    (beside / "json.py").write_text("")
    plugin.search(beside)
    assert plugin.load_module("json", "").__file__ != str(beside / "json.py")
    plugin.load_module("plugin_meter", "")
    assert sys.path.count(str(beside)) == 1


# Names without imports


@pytest.mark.parametrize(
    "name", ["plugin_meter:Good", "plugin_broken:Any", "plugin_exits:Any", "plugin_package.inner:Inner"]
)
def test_a_class_is_found_by_name_without_running_its_module(
    beside: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, name.partition(":")[0], raising=False)
    (beside / "plugin_package").mkdir()
    (beside / "plugin_package" / "__init__.py").write_text("1 / 0\n")
    (beside / "plugin_package" / "inner.py").write_text("1 / 0\nif True:\n    class Inner: pass\n")
    for broken in ("plugin_broken", "plugin_exits"):
        with (beside / f"{broken}.py").open("a") as file:
            file.write("from typing import Any\n")
    former = list(sys.path)
    with plugin.names_only() as skipped:
        with pytest.raises(NotTrustedError) as raised:
            plugin.load(name, "a.yaml: meter", Meter)
        assert skipped == [name]
        assert not plugin.may_import()
    assert has_terms(raised.value.faults[0], "a.yaml: meter", repr(name), "--trust")
    assert name.partition(":")[0] not in sys.modules
    assert sys.path == former  # otherwise later imports of packages that are not installed would be found there
    assert plugin.may_import()


@pytest.mark.parametrize(
    ("name", "terms"),
    [
        ("plugin_nowhere:Good", ("'plugin_nowhere:Good'", "ModuleNotFoundError")),
        ("plugin_meter.inner:Good", ("'plugin_meter.inner:Good'", "plugin_meter is not a package")),
        ("plugin_meter:Bad", ("'plugin_meter:Bad'", "Good, Half")),
        ("plugin_unread:Good", ("'plugin_unread:Good'", "SyntaxError")),
    ],
)
def test_a_missing_name_is_refused_without_running_its_module(beside: Path, name: str, terms: tuple[str, ...]) -> None:
    (beside / "plugin_unread.py").write_text("class\n")
    with plugin.names_only() as skipped:
        with pytest.raises(DocumentError) as raised:
            plugin.load(name, "a.yaml: meter", Meter)
        assert skipped == []
    assert not isinstance(raised.value, NotTrustedError)
    assert has_terms(raised.value.faults[0], "a.yaml: meter", *terms)
    with plugin.names_only(looked_up=False) as skipped:
        with pytest.raises(NotTrustedError):
            plugin.load(name, "a.yaml: meter", Meter)
        assert skipped == [name]


def test_code_of_zsim_itself_is_always_imported() -> None:
    with plugin.names_only():
        assert plugin.load_module("zsim.errors", "a.yaml: module") is sys.modules["zsim.errors"]


def test_child_processes_import_no_user_code_either(beside: Path) -> None:
    code = "from zsim.schema import plugin; plugin.load_module('plugin_meter', 'a.yaml: module')"
    with plugin.names_only():
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert has_terms(done.stderr.splitlines()[-1], "a.yaml: module", "'plugin_meter'", "--trust")
