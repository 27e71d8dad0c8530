"""Part d: the age of a command on arrival at the world, in realtime, since the samples that it answers were published.

For comparison, bare Zenoh is timed in the same run, with a client for each of the N drones: a round trip, and the path
of a command (from the hub to N clients, through the hub to one more client that waits for all of them, and back).
"""

import sys
import tempfile
from pathlib import Path

from benchmarks import grid
from benchmarks.child import RefusedError, result
from benchmarks.run import fly
from benchmarks.sheet import Progress, Sheet
from benchmarks.table import spread, table

SIZES = (3, 30)
SECONDS = 15.0  # simulated, which is also wall time
BARE_SECONDS = 5.0
TIMEOUT_S = 120.0
ZSIM: dict[str, tuple[str, ...]] = {"hosted": ("--hosted",), "zsim": ()}
QUANTILES = ("p50", "p99", "max")
LABELS = {
    "trip": "bare Zenoh, there and back",
    "command": "bare Zenoh, the path of a command",
    "hosted": "zsim, estimators and controller in one process (`--hosted`)",
    "zsim": "zsim, a process for each",
}


def measure(repeats: int) -> Sheet:
    """Fly in realtime and time bare Zenoh, in turn, at every size."""
    sheet = Sheet("d", "ms")
    progress = Progress("d", repeats * len(SIZES) * len(LABELS))
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(repeats):
            for size in SIZES:
                for name in LABELS:
                    progress.tell(f"{LABELS[name]}, N = {size}: {_measured(sheet, name, size, Path(folder))}")
    return sheet


def _measured(sheet: Sheet, name: str, size: int, folder: Path) -> str:
    try:
        found = _realtime(size, folder, ZSIM[name]) if name in ZSIM else _bare(name, size)
    except RefusedError as error:
        return sheet.refuse(name, size, str(error), [f"{name}_{quantile}" for quantile in QUANTILES])
    for key, value in found.items():
        sheet.add(f"{name}_{key}", size, value)
    return ", ".join(f"{key} {value:.2f} ms" for key, value in found.items() if key in QUANTILES)


def _realtime(size: int, folder: Path, options: tuple[str, ...]) -> dict[str, float]:
    path = folder / f"realtime{size}.yaml"
    grid.write(path, size, SECONDS, cluster=size)
    found, _ = fly(path, SECONDS, "--realtime", *options)
    ages: dict[str, float] = found["command_age_ms"]  # type: ignore[assignment]
    if ages.get("p50") is None:
        raise RefusedError("no command reached the world")
    return {quantile: ages[quantile] for quantile in QUANTILES} | {"deadline_misses": found["deadline_misses"]}


def _bare(path: str, size: int) -> dict[str, float]:
    module = "benchmarks.exchange.paced_zenoh"
    options = ["--agents", str(size), "--seconds", str(BARE_SECONDS), "--path", path]
    found = result([sys.executable, "-m", module, *options], TIMEOUT_S)
    return {quantile: found[quantile] for quantile in QUANTILES}


def page(sheet: Sheet) -> str:
    rows = []
    for size in SIZES:
        for name, label in LABELS.items():
            cells = [spread(sheet.spread(f"{name}_{quantile}", size)) for quantile in QUANTILES]
            if refused := sheet.refused.get(f"{name}@{size}"):
                cells.append(f"refused: {refused}")
            rows.append([str(size), label, *cells])
        compared = [spread(sheet.ratio(f"zsim_{quantile}", f"command_{quantile}", size)) for quantile in QUANTILES]
        rows.append([str(size), "zsim / bare Zenoh, the path of a command", *compared])
    head = [f"deadline misses in {SECONDS:g} s", *(f"N = {size}" for size in SIZES)]
    misses = [
        [LABELS[name], *(spread(sheet.spread(f"{name}_deadline_misses", size)) for size in SIZES)] for name in ZSIM
    ]
    return f"{table(['N', '[ms]', *QUANTILES], rows)}\n\n{table(head, misses)}"
