"""Part c with `--against REV`: this working tree against another commit of zsim, in turn on one machine.

Each revision flies its own Test 1 with the same seed and duration, and a grid of 99 drones. Processor time is that of a
long flight minus that of a short one, which excludes start-up and shutdown. A ratio above 1 means that this tree is
better: real-time factor here / there, processor time and memory there / here.
"""

import contextlib
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from packaging.requirements import Requirement

from benchmarks import grid
from benchmarks.child import RefusedError
from benchmarks.peers import ROOT
from benchmarks.real_time_factor import LABELS, OPTIONS
from benchmarks.run import end_event, spent
from benchmarks.sheet import Progress, Sheet
from benchmarks.table import spread, table

GRID = 99  # drones; 33 clusters of three, so that no drone is left over
SEED = 1
FLOWN = ("world", "agents", "record")  # optional dependencies that a flight needs


class Flight(NamedTuple):
    """A flight that both revisions make."""

    label: str  # shown in tables
    drones: int
    options: tuple[str, ...]  # options of `zsim run`
    short_s: float  # simulated; duration of the short flight, whose processor time is subtracted
    long_s: float  # simulated; duration of the long flight


FLIGHTS = {
    **{name: Flight(f"Test 1, {label}", 3, OPTIONS[name], 10.0, 330.0) for name, label in LABELS.items()},
    # the grid takes off at 1 s, and all its formations are engaged by 4 s
    "grid": Flight(f"{GRID} drones, one process (`--in-process`)", GRID, ("--in-process",), 4.0, 14.0),
}
QUANTITIES = {"factor": "× real time", "cpu": "CPU ms per drone-second", "peak": "greatest resident memory, MB"}


class Side(NamedTuple):
    """A revision: its checkout, and the Python that imports zsim from it."""

    root: Path
    python: Path


def measure(repeats: int, revision: str, names: Sequence[str] = tuple(FLIGHTS)) -> Sheet:
    """Fly both revisions in turn.

    Args:
        repeats: number of turns.
        revision: a hash, a tag, a branch, or a relative name such as `HEAD~3`.
        names: keys of `FLIGHTS`.

    Raises:
        RefusedError: git does not know the revision, a package that it needs cannot be installed, or a revision's first
            flight fails.
    """
    sheet = Sheet("c-against", "")
    flights = {name: FLIGHTS[name] for name in FLIGHTS if name in names}
    progress = Progress("c", 2 * repeats * len(flights) + 2)
    with tempfile.TemporaryDirectory() as temporary, checked_out(revision, Path(temporary)) as there:
        sheet.notes = {"against": described(there.root), "here": described(ROOT)}
        grid.write(Path(temporary) / "grid.yaml", GRID, FLIGHTS["grid"].long_s)
        sides = {"here": Side(ROOT, Path(sys.executable)), "there": there}
        for side in sides.values():
            _flown(side, FLIGHTS["in_process"], 2.0, side.root / "scenarios" / "step.yaml")
            progress.tell(f"{described(side.root)}: compiled")
        for turn in range(repeats):
            for name, flight in flights.items():
                for mine in sorted(sides, reverse=bool(turn % 2)):  # so that neither is always first
                    side = sides[mine]
                    path = Path(temporary) / "grid.yaml" if name == "grid" else side.root / "scenarios" / "step.yaml"
                    progress.tell(f"{mine}, {flight.label}: {_measured(sheet, mine, name, flight, side, path)}")
    return sheet


@contextlib.contextmanager
def checked_out(revision: str, folder: Path) -> Iterator[Side]:
    """Check out a revision, with an environment that shares the installed packages; remove the checkout at the end.

    Raises:
        RefusedError: git does not know the revision, or a package that it needs cannot be installed.
    """
    root = folder / "checkout"
    _ran(["git", "-C", str(ROOT), "worktree", "add", "--detach", "--quiet", str(root), revision], "git")
    try:
        yield Side(root, _environment(root, folder / "venv"))
    finally:
        remove = ["git", "-C", str(ROOT), "worktree", "remove", "--force", str(root)]
        subprocess.run(remove, capture_output=True, check=False)


def _environment(root: Path, folder: Path) -> Path:
    """Make an environment with zsim from a checkout, the current packages and those it lacks; return its Python."""
    project = tomllib.loads((root / "pyproject.toml").read_text())
    ours = project["tool"]["hatch"]["build"]["dev-mode-dirs"]
    shared = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    _ran([sys.executable, "-m", "venv", "--without-pip", str(folder)], "venv")
    python = folder / "bin" / "python"
    packages = next((folder / "lib").glob("python*")) / "site-packages"
    (packages / "zsim.pth").write_text("".join(f"{path}\n" for path in [*(root / name for name in ours), *shared]))
    if unmet := _unmet(project["project"]):
        pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--disable-pip-version-check"]
        _ran([*pip, *unmet], "pip")
    return python


def _unmet(project: dict[str, Any]) -> list[str]:
    """Return the requirements of a flight that the installed packages do not meet."""
    extras = project.get("optional-dependencies", {})
    texts = [*project["dependencies"], *(text for extra in FLOWN for text in extras.get(extra, []))]
    wanted = [found for found in map(Requirement, texts) if found.name != project["name"]]
    return [str(found) for found in wanted if not _met(found)]


def _met(wanted: Requirement) -> bool:
    if wanted.marker is not None and not wanted.marker.evaluate():
        return True
    try:
        return wanted.specifier.contains(version(wanted.name), prereleases=True)
    except PackageNotFoundError:
        return False


def _ran(command: Sequence[str], name: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip()]
        raise RefusedError(f"{name}: {said[-1] if said else f'exit code {done.returncode}'}")


def described(root: Path) -> str:
    """Return the commit and date of a checkout, with `-dirty` if it has uncommitted changes."""
    asked = ["git", "-C", str(root), "log", "-1", "--format=%cs"]
    date = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    asked = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    commit = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    return f"{commit} of {date}"


def _measured(sheet: Sheet, mine: str, name: str, flight: Flight, side: Side, path: Path) -> str:
    """Make a short and a long flight, add the results, or why a flight failed, to the sheet; return them as text."""
    try:
        _, short_cpu_s, _ = _flown(side, flight, flight.short_s, path)
        factor, long_cpu_s, peak_mb = _flown(side, flight, flight.long_s, path)
    except RefusedError as error:
        return sheet.refuse(f"{mine}.{name}", flight.drones, str(error), [f"{mine}.{name}.{key}" for key in QUANTITIES])
    cpu_ms = 1e3 * (long_cpu_s - short_cpu_s) / (flight.long_s - flight.short_s) / flight.drones
    for key, value in zip(QUANTITIES, (factor, cpu_ms, peak_mb), strict=True):
        sheet.add(f"{mine}.{name}.{key}", flight.drones, value)
    return f"{factor:.1f} × real time, {cpu_ms:.2f} CPU ms per drone-second, {peak_mb:.0f} MB"


def _flown(side: Side, flight: Flight, seconds: float, path: Path) -> tuple[float, float, float]:
    """Fly once; return real-time factor, CPU seconds of all processes, peak resident memory of the largest one [MB]."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [str(side.python), "-m", "zsim_deploy.cli", "run", str(path), "--no-report", "--seed", str(SEED)]
        told = spent([*command, "--duration", str(seconds), "--out", str(out), *flight.options], side.root)
        return end_event(out)["real_time_factor"], told.cpu_s, told.peak_mb


def page(sheet: Sheet) -> str:
    here, there = sheet.notes["here"], sheet.notes["against"]
    rows = []
    for name, flight in FLIGHTS.items():
        for key, label in QUANTITIES.items():
            mine, its = (f"{side}.{name}.{key}" for side in ("here", "there"))
            if mine not in sheet.values and its not in sheet.values:
                continue
            better = (mine, its) if key == "factor" else (its, mine)
            cells = [_cell(sheet, who, flight.drones) for who in (mine, its)]
            rows.append([f"{flight.label}: {label}", *cells, spread(sheet.ratio(*better, flight.drones))])
    return table(["", f"here: {here}", f"there: {there}", "ratio (above 1: here is better)"], rows)


def _cell(sheet: Sheet, contender: str, size: int) -> str:
    found = sheet.spread(contender, size)
    return spread(found) if found else sheet.refused.get(f"{contender.rsplit('.', 1)[0]}@{size}", "–")
