"""Part e: cost of each additional drone, start-up time of each role, and needs of an onboard estimator."""

import sys
import tempfile
from pathlib import Path

from benchmarks import onboard, start_up
from benchmarks.child import RefusedError, result
from benchmarks.sheet import Progress, Sheet, exponent
from benchmarks.table import PICTURES, figure, lines, spread, table

SIZES = {1: 10.0, 3: 10.0, 10: 6.0, 30: 3.0, 100: 1.5}  # number of drones: simulated duration [s]
TIMEOUT_S = 300.0
CPU = "CPU ms per drone-second"
ONBOARD = {"plain": "extra `agents`, without numba", "numba": "extra `agents`"}


def measure(repeats: int) -> Sheet:
    """Install both onboard estimators; then repeatedly fly every size, start every role and fly both estimators."""
    sheet = Sheet("e", CPU)
    progress = Progress("e", repeats * (len(SIZES) + 1 + len(ONBOARD)))
    with tempfile.TemporaryDirectory() as folder:
        pythons = {variant: _installed(sheet, variant, Path(folder)) for variant in ONBOARD}
        _grown(Sheet("e", CPU), 3, 0.5)  # compiles the kernels before anything is timed
        for number in range(repeats):
            for size, seconds in SIZES.items():
                progress.tell(f"in one process, N = {size}: {_grown(sheet, size, seconds)}")
            place = Path(folder) / str(number)
            place.mkdir()
            progress.tell(f"start of every role: {_started(sheet, place)}")
            for variant, python in pythons.items():
                progress.tell(f"onboard, {variant}: {_onboard(sheet, variant, python, place)}")
    return sheet


def _grown(sheet: Sheet, size: int, seconds: float) -> str:
    command = [sys.executable, "-m", "benchmarks.flight", "--drones", str(size), "--seconds", str(seconds)]
    try:
        found = result(command, TIMEOUT_S)
    except RefusedError as error:
        return sheet.refuse("in_process", size, str(error), ["in_process"])
    sheet.add("in_process", size, 1e3 * found["cpu_s_per_simulated_s"] / size)
    sheet.add("resident_mb", size, found["resident_mb"])
    return f"{1e3 * found['cpu_s_per_simulated_s'] / size:.1f} ms per drone-second"


def _started(sheet: Sheet, folder: Path) -> str:
    try:
        found = start_up.measure(folder)
    except RefusedError as error:
        sheet.refused["start_up"] = str(error)
        return str(error)
    for name, value in found.items():
        sheet.add(f"start_{name}", 1, value)
    return ", ".join(f"{role} {found[role]:.2f} s" for role in start_up.ROLES)


def _installed(sheet: Sheet, variant: str, folder: Path) -> Path | None:
    """Install a variant of the onboard estimator and fly it once, so that its kernels are compiled."""
    print(f"e installing an onboard estimator, {variant}", file=sys.stderr, flush=True)
    try:
        python = onboard.install(variant)
        onboard.fly(python, folder)
    except RefusedError as error:
        sheet.refused[variant] = str(error)
        return None
    sheet.add(f"{variant}_installed_mb", 1, onboard.installed_mb(python))
    return python


def _onboard(sheet: Sheet, variant: str, python: Path | None, folder: Path) -> str:
    if python is None:
        return sheet.refused[variant]
    try:
        found = onboard.fly(python, folder)
    except RefusedError as error:
        sheet.refused[variant] = str(error)
        return str(error)
    for name, value in found.items():
        sheet.add(f"{variant}_{name}", 1, value)
    return ", ".join(f"{name} {value:.1f}" for name, value in found.items())


def page(sheet: Sheet) -> str:
    lines(
        sheet, {"in_process": "everything in one process"}, PICTURES / "bench_e.svg", "Cost of a drone", "drones", "in"
    )
    picture = "![CPU time per drone-second](results/bench_e.svg)"
    return "\n\n".join([_growth(sheet), picture, _starts(sheet), _onboards(sheet)])


def _growth(sheet: Sheet) -> str:
    sizes = list(SIZES)
    per_drone = ["CPU ms per drone-second", *(spread(sheet.spread("in_process", size)) for size in sizes)]
    resident = ["resident, MB", *(spread(sheet.spread("resident_mb", size)) for size in sizes)]
    told = table(["one process", *(f"N = {size}" for size in sizes)], [per_drone, resident])
    costs = {size: size * s.median for size in sizes if (s := sheet.spread("in_process", size))}
    memory = {size: s.median for size in sizes if (s := sheet.spread("resident_mb", size))}
    words = []
    if len(costs) > 1:
        tail = dict(list(costs.items())[-3:])
        shown = f"{exponent(costs):.2f} over all N, {exponent(tail):.2f} from N = {min(tail)} on"
        words.append(f"CPU time of a simulated second grows with N to the power {shown}.")
    if len(memory) > 1:
        first, last = min(memory), max(memory)
        slope = (memory[last] - memory[first]) / (last - first)
        words.append(f"Memory: {figure(slope)} MB for each additional drone (N = {first} to {last}).")
    return f"{told}\n\n{' '.join(words)}"


def _starts(sheet: Sheet) -> str:
    rows = [
        [f"`{label}`", spread(sheet.spread(f"start_{role}", 1)), spread(sheet.spread(f"start_{role}_mb", 1))]
        for role, label in start_up.ROLES.items()
    ]
    if "start_up" in sheet.refused:
        rows.append(["not measured", sheet.refused["start_up"], ""])
    return table(["", "s until ready", "resident when ready, MB"], rows)


def _onboards(sheet: Sheet) -> str:
    rows = []
    for variant, label in ONBOARD.items():
        names = ("installed_mb", "resident_mb", "cpu_ms_per_simulated_s")
        cells = [spread(sheet.spread(f"{variant}_{name}", 1)) for name in names]
        rows.append([label, *cells] if variant not in sheet.refused else [label, sheet.refused[variant], "", ""])
    head = ["estimator onboard", "installed, MB", "resident, MB", "CPU ms per simulated second"]
    return table(head, rows)
