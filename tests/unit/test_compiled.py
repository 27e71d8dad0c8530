"""The compiled mathematics: every file that is compiled counts for the cache, and a change of one renews it."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import zsim_agents
from zsim_agents.compiled import CONSTANTS, SOURCES, sources_digest

PACKAGE = Path(zsim_agents.__file__).parent


def test_every_file_with_compiled_functions_is_listed():
    users = {path.name for path in PACKAGE.glob("*.py") if "\n@compiled\n" in path.read_text()}
    assert users == set(SOURCES)


def test_every_file_that_the_estimators_kernel_imports_is_listed():
    """Where a function is compiled, the constants that it names are too, wherever they come from."""
    texts = [(PACKAGE / name).read_text() for name in SOURCES if name.startswith("estimator_")]
    imported = {name for text in texts for name in re.findall(r"^from zsim_agents\.(\w+) import", text, re.MULTILINE)}
    assert {f"{name}.py" for name in imported} - {"compiled.py"} <= {*SOURCES, *CONSTANTS}


def test_the_digest_changes_with_each_file(tmp_path: Path):
    digests = set()
    files = (*SOURCES, *CONSTANTS)
    for changed in (None, *files):
        for name in files:
            shutil.copy(PACKAGE / name, tmp_path)
        if changed:
            with (tmp_path / changed).open("a") as file:
                file.write("# another line\n")
        digests.add(sources_digest(tmp_path))
    assert len(digests) == len(files) + 1


ASK = """
from zsim_agents.dead_reckoning import acceleration
print(acceleration((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 9.0))
"""


def test_a_change_of_what_is_called_reaches_the_caller(tmp_path: Path):
    """`dead_reckoning.acceleration` calls `madgwick.turn`: numba's own cache would go on with the old one."""
    pytest.importorskip("numba")
    shutil.copytree(PACKAGE, tmp_path / "zsim_agents", ignore=shutil.ignore_patterns("__pycache__"))

    def ask() -> str:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        run = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}){ASK}"]
        return subprocess.run(run, env=environment, capture_output=True, text=True, check=True).stdout.strip()

    assert ask() == "(0.0, 0.0, -9.0)"
    madgwick = tmp_path / "zsim_agents" / "madgwick.py"
    text = madgwick.read_text()
    assert text.count("        R[0] * v[0] + R[1] * v[1] + R[2] * v[2],") == 1
    madgwick.write_text(text.replace("        R[0] * v[0] + R[1]", "        1.0 + R[0] * v[0] + R[1]"))
    assert ask() == "(1.0, 0.0, -9.0)"


def test_a_kernel_is_known_to_be_kept_once_it_was_compiled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    pytest.importorskip("numba")
    from zsim_world.compiled import is_kept, kernel

    (tmp_path / "doubling.py").write_text("def doubled(x: float) -> float:\n    return 2.0 * x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import doubling  # type: ignore[import-not-found]

    made = kernel([tmp_path / "doubling.py"])(doubling.doubled)
    assert not is_kept(made)
    assert made(2.0) == 4.0
    assert is_kept(made)
