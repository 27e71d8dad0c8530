"""Compiled mathematics: a change in any source file of a kernel renews its cache; columns of rows."""

import importlib
import os
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import zsim
from zsim.math import compiled
from zsim.math.compiled import Field, columns, portable

ROOT = Path(zsim.__file__).parents[1]


def names(module: str) -> set[str]:
    return {path.stem for path in compiled.sources(importlib.import_module(module).__name__)}


def test_the_sources_of_a_kernel_are_all_modules_it_imports():
    """A function is compiled together with what it calls and the constants it names, wherever they are defined."""
    assert {"kalman_update", "strapdown", "compiled"} <= names("zsim_agents.estimation.estimator_bank")
    pytest.importorskip("numba")
    own, of_zsim = {"kernel", "firmware", "rigid_body", "simd", "sensor_set"}, {"rotation", "vehicle", "surroundings"}
    assert own | of_zsim | {"compiled"} <= names("zsim_world.fleet.kernel")
    assert "kernel" not in names("zsim_world.sensors.noise")


def test_the_digest_depends_on_file_contents_but_not_on_folders(tmp_path: Path):
    digests = set()
    for case, texts in enumerate((("a", "b"), ("A", "b"), ("a", "B"), ("b", "a"))):
        files = [tmp_path / str(case) / name for name in ("one.py", "two.py")]
        files[0].parent.mkdir()
        for file, text in zip(files, texts, strict=True):
            file.write_text(text)
        digests.add(compiled.digest(files))
    assert len(digests) == 3


ASK = """
import numpy as np
from zsim_agents.estimation.joint_filter import place_of
print(place_of(np.ones(20)))
"""


def test_a_change_in_a_called_function_recompiles_the_caller(tmp_path: Path):
    """`joint_filter.place_of` calls `filter_state.vector`: numba's own cache would continue to use the old one."""
    pytest.importorskip("numba")
    shutil.copytree(
        ROOT / "agents" / "zsim_agents", tmp_path / "zsim_agents", ignore=shutil.ignore_patterns("__pycache__")
    )

    def ask() -> str:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        run = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}){ASK}"]
        return subprocess.run(run, env=environment, capture_output=True, text=True, check=True).stdout.strip()

    assert ask() == "(1.0, 1.0, 1.0)"
    called = tmp_path / "zsim_agents" / "estimation" / "filter_state.py"
    text, line = called.read_text(), "return float(row[at]), float(row[at + 1]), float(row[at + 2])\n"
    assert text.count(line) == 1
    called.write_text(text.replace(line, line.replace("return ", "return 1.0 + ")))
    assert ask() == "(2.0, 1.0, 1.0)"


def test_a_compiled_kernel_is_reported_as_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    pytest.importorskip("numba")
    from zsim.math.compiled import is_kept, kernel

    (tmp_path / "doubling.py").write_text("def doubled(x: float) -> float:\n    return 2.0 * x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import doubling  # type: ignore[import-not-found]

    made = kernel()(doubling.doubled)
    assert not is_kept(made)
    assert made(2.0) == 4.0
    assert is_kept(made)


DOUBLED = """
import os, sys, time
from pathlib import Path
from numba.core import event
from zsim.math.compiled import kernel

class Compilations(event.Listener):
    def on_start(self, event):
        print("compiles", flush=True)
        while len(list(Path().glob("calls-*"))) < 3:
            time.sleep(0.01)

    def on_end(self, event): pass

@kernel()
def doubled(x):
    return 2.0 * x

event.register("numba:compile", Compilations())
print("ready", flush=True)
sys.stdin.read()
Path(f"calls-{os.getpid()}").touch()
print(doubled(2.0))
"""


def test_processes_that_start_together_compile_a_kernel_once(tmp_path: Path):
    pytest.importorskip("numba")
    (tmp_path / "doubling.py").write_text(DOUBLED)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    with ExitStack() as stack:
        command, pipe = [sys.executable, "-c", "import doubling"], subprocess.PIPE
        more: Any = {"env": environment, "cwd": tmp_path, "stdin": pipe, "stdout": pipe, "text": True}
        started = [subprocess.Popen(command, **more) for _ in range(3)]
        processes = [stack.enter_context(each) for each in started]
        for each in processes:
            assert each.stdout is not None
            assert each.stdout.readline() == "ready\n"
        for each in processes:
            assert each.stdin is not None
            each.stdin.close()
        said = [each.stdout.read().split() for each in processes if each.stdout is not None]
    assert sorted(said) == [["4.0"], ["4.0"], ["compiles", "4.0"]]
    assert not list((tmp_path / "cache").rglob("*.lock"))


DEFERRED = """
import pickle, sys
from zsim.math.elementary import elementwise, exp, power
from zsim.math.linear import solve

def computed():
    return [exp(0.3).hex(), power(-2.0, -3.0).hex(), *map(float.hex, elementwise(exp)([0.1, 0.2])), str(solve([[3.0]], [1.0]))]

before = computed()
assert "numba" not in sys.modules
import zsim.math.rotation
assert "numba" in sys.modules
assert computed() == before
assert exp.dispatcher.signatures and pickle.loads(pickle.dumps(exp)) is exp
"""


def test_a_deferred_kernel_gives_the_same_bits_before_numba_is_imported():
    pytest.importorskip("numba")
    subprocess.run([sys.executable, "-c", DEFERRED], check=True)


PART = """
from numba.core import event
from zsim.math.compiled import inlined, kernel

@inlined
def halved(x):
    return 0.5 * x

@kernel()
def quarter(x):
    return halved(halved(x))

compilations = event.RecordingListener()
event.register("numba:compile", compilations)
print(quarter(2.0), halved(2.0), len(compilations.buffer) // 2)
"""


def test_inlined_parts_of_a_kernel_are_cached_when_called_from_python(tmp_path: Path):
    pytest.importorskip("numba")
    (tmp_path / "halving.py").write_text(PART)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    run = [sys.executable, "-c", "import halving"]
    for compilations in ("3", "0"):  # compilations: the kernel, its part, and the part called from Python
        made = subprocess.run(run, env=environment, capture_output=True, text=True, check=True)
        assert made.stdout.split() == ["0.5", "1.0", compilations]


HELD = """
from typing import NamedTuple
import numpy as np
from zsim.math.held import hold

class {name}(NamedTuple):
    row: np.ndarray

hold({name}(np.ones(3)))
"""


def test_tuples_are_held_after_their_class_is_renamed(tmp_path: Path):
    """Numba's index of cached code names the classes: a class that no longer exists would make the index unreadable."""
    pytest.importorskip("numba")
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    for name in ("Former", "Present"):
        (tmp_path / "held_rows.py").write_text(HELD.format(name=name))
        run = [sys.executable, "-c", "import held_rows; print('held')"]
        made = subprocess.run(run, env={**os.environ, **cache}, capture_output=True, text=True, check=False)
        assert (made.stdout.strip(), made.stderr) == ("held", "")


ROW = columns("Row", (Field("p_WB", "m", 3), Field("energy", "J"), Field("q_WB", "1", 4)))


@portable
def total(row):
    return row[ROW.energy] + row[ROW.q_WB]


def test_fields_are_consecutive_columns_that_compiled_code_reads():
    assert (ROW.p_WB, ROW.energy, ROW.q_WB, ROW.size) == (0, 3, 4, 8)
    assert total(np.arange(8.0)) == 7.0
    with pytest.raises(ValueError, match="p_WB"):
        columns("Row", (Field("p_WB", "m", 3), Field("p_WB", "m", 3)))
