"""The notebooks in docs/ run, and contain the outputs of a full run.

The metadata of a cell of parameters has a replacement, `short`, with which the notebook takes only seconds.
"""

import copy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))
PATIENCE_S = 1800  # wall time per cell on a busy machine
SIZE_MAX = 1_000_000  # bytes per notebook, including pictures

nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
pytest.importorskip("ipykernel", reason="ipykernel is not installed")
SOAKED = ("2-own-estimator", "3-own-law", "4-train-a-policy")  # other tests cover what they show
AT_ONCE = [pytest.param(each, marks=[pytest.mark.soak] if each.stem in SOAKED else []) for each in NOTEBOOKS]
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def pictures(notebook: Any) -> list[int]:
    """Return the number of pictures below each cell."""
    return [sum("image/png" in each.get("data", {}) for each in cell.outputs) for cell in code_cells(notebook)]


def executed(path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, short: bool) -> Any:
    """Run a copy of a notebook in a folder laid out like the repository. Raises CellExecutionError if a cell raises."""
    notebook = copy.deepcopy(nbformat.read(path, as_version=4))
    for cell in notebook.cells:
        if short and "short" in cell.metadata:
            cell.source = cell.metadata["short"]
    monkeypatch.setenv("TMPDIR", str(folder))  # the kernel is killed and leaves its temporary files
    for name in ("scenarios", "examples"):
        (folder / name).symlink_to(ROOT / name)
    where = folder / "docs/notebooks"
    where.mkdir(parents=True)
    options = {"resources": {"metadata": {"path": str(where)}}, "kernel_name": "python3"}
    nbclient.NotebookClient(notebook, timeout=PATIENCE_S, **options).execute()
    return notebook


@each_notebook
def test_a_notebook_contains_the_outputs_of_a_full_run(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < SIZE_MAX
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert sum(pictures(notebook)) >= 1
    assert [cell.source for cell in cells if cell.source == cell.metadata.get("short")] == []
    assert any("short" in cell.metadata for cell in cells)
    for output in (output for cell in cells for output in cell.outputs):
        assert output.output_type != "error"
        assert output.get("name") != "stderr", output.text
        shown = str(output.get("text", output.get("data", {}).get("text/plain", "")))
        assert str(Path.home()) not in shown
        assert str(ROOT) not in shown


@pytest.mark.slow
@pytest.mark.parametrize("path", AT_ONCE, ids=lambda each: each.stem)
def test_a_notebook_runs_with_short_parameters(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert pictures(executed(path, tmp_path, monkeypatch, short=True)) == pictures(nbformat.read(path, as_version=4))


@pytest.mark.soak
@each_notebook
def test_a_notebook_runs_in_full(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert pictures(executed(path, tmp_path, monkeypatch, short=False)) == pictures(nbformat.read(path, as_version=4))
