"""Naming of classes, functions and instances of notebooks and scripts, so that other processes can load them."""

import importlib
import linecache
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from refused import has_terms

from zsim.errors import NotTrustedError, RunError
from zsim.schema import plugin
from zsim_analysis.reading.formation import formations_of
from zsim_api.own_code import module_folders, name_of

CELL = """
import math
from zsim_agents.formation.control_law import ControlLaw

GAIN = 0.5

def half(number):
    return GAIN * number

class Base(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return half(c)

class Law(Base):
    '''Of a cell.'''
    factor = math.tau

    def scaled(self):
        return self.factor * half(4.0)

    def fails(self):
        return 1 / 0  # here
"""
CELL_PATH = "/tmp/ipykernel_4711/2983123.py"


@pytest.fixture
def searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder that is searched for modules."""
    monkeypatch.setenv(plugin.FOLDERS, "")
    monkeypatch.setattr(sys, "path", [*sys.path])
    plugin.search(tmp_path)
    return tmp_path


def cell(text: str, path: str = CELL_PATH) -> dict[str, Any]:
    """Run a cell of a notebook as a kernel does, and return its namespace."""
    names: dict[str, Any] = {"__name__": "__main__", "__builtins__": __builtins__}
    linecache.cache[path] = (len(text), None, text.splitlines(keepends=True), path)
    exec(compile(text, path, "exec"), names)
    return names


def printed(folder: Path, code: str) -> str:
    """Return the output of another process that searches the folder for modules."""
    code = f"import sys; sys.path.append({str(folder)!r}); {code}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    return done.stdout.strip() or done.stderr


def test_the_name_of_a_cell_s_class_gives_the_same_class_here(searched: Path) -> None:
    law = cell(CELL)["Law"]
    name = name_of(law, searched)
    module, _, attribute = name.partition(":")
    assert attribute == "Law"
    assert plugin.load(name, "law", law) is law
    text = (searched / f"{module}.py").read_text()
    assert "#     '''Of a cell.'''\n#     factor = math.tau\n" in text


def test_another_process_loads_the_class_with_its_dependencies(searched: Path) -> None:
    module, _, _ = name_of(cell(CELL)["Law"], searched).partition(":")
    assert printed(searched, f"from {module} import Law; print(Law.scaled(Law))") == "12.566370614359172"


def test_the_same_class_has_the_same_name_in_every_kernel(searched: Path) -> None:
    first = name_of(cell(CELL)["Law"], searched)
    assert name_of(cell(CELL, CELL_PATH.replace("4711", "12"))["Law"], searched) == first
    assert len(list(searched.iterdir())) == 1
    names = cell(CELL)
    names["Law"].factor = 2.0
    assert name_of(names["Law"], searched) != first
    assert name_of(cell(CELL.replace("0.5", "0.6"))["Law"], searched) != first


def test_a_name_does_not_depend_on_the_hash_seed(tmp_path: Path) -> None:
    code = f"class Law:\n    a, b, c = 'x', 'y', 'z'\nfrom zsim_api.own_code import name_of\nfrom pathlib import Path\nprint(name_of(Law, Path({str(tmp_path)!r})))"
    names = {
        subprocess.run(
            [sys.executable, "-c", code], env={"PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True
        ).stdout
        for seed in "12"
    }
    assert len(names) == 1


def test_an_importable_object_is_named_by_its_own_module(searched: Path) -> None:
    assert name_of(formations_of, searched) == "zsim_analysis.reading.formation:formations_of"
    assert list(searched.iterdir()) == []


def test_the_folder_of_a_module_beside_the_script_is_searched(searched: Path) -> None:
    (searched / "beside_the_script.py").write_text("class Law: pass\n")
    sys.path.append(str(searched))
    module = importlib.import_module("beside_the_script")
    name = name_of(module.Law, searched / "run")
    assert name == "beside_the_script:Law"
    assert module_folders([name]) == [searched]
    uses = cell("import beside_the_script, numpy\ndef metric(flight): return numpy.size(beside_the_script.Law)")
    assert module_folders([name_of(uses["metric"], searched / "run")]) == [searched]
    del sys.modules["beside_the_script"]


def test_a_class_of_a_module_without_a_file_is_stored_by_value(searched: Path) -> None:
    made = ModuleType("made_by_a_test_runner")
    sys.modules[made.__name__] = made
    exec("class Base: number = 7\nclass Law(Base): pass", made.__dict__)
    module, _, _ = name_of(made.Law, searched).partition(":")
    del sys.modules[made.__name__]
    assert printed(searched, f"from {module} import Law; print(Law.number)") == "7"


def test_functions_and_instances_are_named(searched: Path) -> None:
    class Agent:
        def __init__(self, number: int) -> None:
            self.number = number

    agent, offset = Agent(3), 2.0
    name = name_of(agent, searched)
    module, _, attribute = name.partition(":")
    assert attribute == "Agent"
    assert getattr(sys.modules[module], attribute) is agent
    code = f"import {module}; print({module}.Agent.number)"
    assert printed(searched, code) == "3"
    module, _, attribute = name_of(lambda flight: flight + offset, searched).partition(":")
    assert attribute == "function"
    assert printed(searched, f"from {module} import function; print(function(1))") == "3.0"
    assert name_of(lambda flight: flight, searched, "settled_s").endswith(":settled_s")


UNPICKLABLE = {
    "attribute": "import threading\nclass Law:\n    log = threading.Lock()\n",
    "global": "import threading\nlog = threading.Lock()\nclass Law:\n    def rates(self): log.acquire()\n",
    "instance": "import threading\nclass Law:\n    def __init__(self): self.log = threading.Lock()\nLaw = Law()\n",
}


@pytest.mark.parametrize(("text", "path"), [*zip(UNPICKLABLE.values(), ("log", "log of rates", "log"), strict=True)])
def test_an_object_that_cannot_be_pickled_is_reported_by_name(text: str, path: str, searched: Path) -> None:
    with pytest.raises(RunError) as raised:
        name_of(cell(text)["Law"], searched)
    assert str(raised.value).startswith(f"{path} of __main__:Law ")
    assert "\n" not in str(raised.value)


def test_an_error_in_a_cell_is_reported_with_its_line() -> None:
    line = CELL.splitlines().index("        return 1 / 0  # here") + 1
    for path, shown in ((CELL_PATH, "of the notebook"), ("<ipython-input-3-0123456789ab>", "In[3]")):
        with pytest.raises(ZeroDivisionError) as raised:
            cell(CELL, path)["Law"].fails(None)
        error = raised.value.with_traceback(raised.value.__traceback__ and raised.value.__traceback__.tb_next)
        failure = plugin.user_code_error(error, "controller.main at 1.00 s")
        assert has_terms(
            str(failure), "controller.main", "__main__:Law.fails", "ZeroDivisionError", f"cell {shown}, line {line}"
        )


def test_code_in_another_process_refers_to_the_cell(searched: Path) -> None:
    module, _, _ = name_of(cell(CELL)["Law"], searched).partition(":")
    code = f"from {module} import Law; print(Law.fails.__code__.co_filename, Law.fails.__globals__['__name__'])"
    assert printed(searched, code) == f"{CELL_PATH} __main__"


def test_untrusted_code_is_not_imported(searched: Path) -> None:
    name = name_of(cell(CELL)["Law"], searched)
    del sys.modules[name.partition(":")[0]]
    with plugin.names_only() as skipped:
        with pytest.raises(NotTrustedError):
            plugin.load(name, "law", object)
        assert skipped == [name]
    assert plugin.load(name, "law", object).__doc__ == "Of a cell."


def test_a_function_can_use_an_array(searched: Path) -> None:
    text = "import numpy as np\nTIMES = np.arange({})\ndef last(flight):\n    return int(TIMES[-1])\n"
    one, same, other = (name_of(cell(text.format(count))["last"], searched) for count in (4, 4, 5))
    assert one == same != other
    sys.modules.pop(other.partition(":")[0])
    assert plugin.load_function(other, "metrics")(None) == 4
