"""Part c: the speed of a complete run with world, estimators, controllers and recorder, in many processes and in one.

The factor is simulated seconds per wall second between the first gate and the last, as in `summary.json`.
"""

import statistics
import tempfile
from pathlib import Path

from benchmarks import grid
from benchmarks.child import RefusedError
from benchmarks.peers import ROOT
from benchmarks.run import fly
from benchmarks.sheet import Progress, Sheet
from benchmarks.table import figure, ratios, table

TEST_1 = ROOT / "scenarios" / "step.yaml"
SIZES = {3: 330.0, 10: 20.0, 30: 8.0, 100: 4.0}  # drone count: simulated seconds; 3 is Test 1, the others are grids
PROCESSES_MAX = 10  # number of drones; beyond it, one process per role needs more memory than many machines have
LABELS = {
    "in_process": "one process (`--in-process`)",
    "hosted": "world, recorder, and one process for all others (`--hosted`)",
    "processes": "processes, one for each role",
}
OPTIONS: dict[str, tuple[str, ...]] = {"in_process": ("--in-process",), "hosted": ("--hosted",), "processes": ()}


def measure(repeats: int) -> Sheet:
    """Fly every size in every mode of LABELS, in turn; as processes, only sizes up to PROCESSES_MAX."""
    sheet = Sheet("c", "× real time")
    todo = [(name, size) for size in SIZES for name in LABELS if name != "processes" or size <= PROCESSES_MAX]
    progress = Progress("c", repeats * len(todo))
    by_role: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        paths = {size: _scenario(Path(folder), size) for size in SIZES}
        fly(TEST_1, 2.0, "--in-process")  # compiles the kernels before anything is timed
        for _ in range(repeats):
            for name, size in todo:
                told = _measured(sheet, name, size, paths[size], by_role)
                progress.tell(f"{LABELS[name]}, N = {size}: {told}")
    sheet.notes["cpu_ms_per_simulated_s_with_start"] = _medians(by_role, SIZES[3])
    return sheet


def _scenario(folder: Path, size: int) -> Path:
    if size == 3:
        return TEST_1
    path = folder / f"grid{size}.yaml"
    grid.write(path, size, SIZES[size])
    return path


def _measured(sheet: Sheet, name: str, size: int, path: Path, by_role: list[dict[str, float]]) -> str:
    try:
        found, cpu = fly(path, SIZES[size], *OPTIONS[name])
    except RefusedError as error:
        return sheet.refuse(name, size, str(error), [name])
    sheet.add(name, size, found["real_time_factor"])
    if name == "processes" and size == 3:
        by_role.append(cpu)
    return f"{found['real_time_factor']:.1f} × real time"


def _medians(by_role: list[dict[str, float]], simulated_s: float) -> dict[str, float]:
    roles = sorted({role for cpu in by_role for role in cpu})
    return {
        role: round(1e3 * statistics.median(cpu.get(role, 0.0) for cpu in by_role) / simulated_s, 2) for role in roles
    }


def page(sheet: Sheet) -> str:
    roles = sheet.notes["cpu_ms_per_simulated_s_with_start"]
    spent = table(
        ["role", "CPU ms per simulated second, start-up included"], [[r, figure(v)] for r, v in roles.items()]
    )
    return f"{ratios(sheet, LABELS, 'in_process')}\n\n{spent}"
