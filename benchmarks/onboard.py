"""Disk, memory and CPU needs of an estimator installed alone, as on an onboard computer, with and without numba.

Each variant is installed from this project into an environment of its own in .venv-bench, and estimates the state of
the only drone of a world that runs unpaced in zsim's own environment.
"""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import psutil

from benchmarks import grid
from benchmarks.child import RefusedError
from benchmarks.exchange.lap import free_port
from benchmarks.peers import FOLDER, ROOT
from benchmarks.run import CLI

REMOVED: dict[str, tuple[str, ...]] = {"plain": ("numba", "llvmlite"), "numba": ()}  # removed after installation
SHORT_S, LONG_S = 5.0, 45.0  # simulated durations of two flights; their difference excludes start-up
TIMEOUT_S = 180.0


def install(variant: str) -> Path:
    """Install a variant from the current working tree and return its Python; raise RefusedError if that fails."""
    folder = FOLDER / f"onboard-{variant}"
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    pip = [str(python), "-m", "pip", "--disable-pip-version-check"]
    install, remove = ["install", "-q"], ["uninstall", "-q", "-y"]
    steps = [[*install, f"{ROOT}[agents]"], [*install, "--force-reinstall", "--no-deps", str(ROOT)]]
    steps += [[*remove, *REMOVED[variant]]] if REMOVED[variant] else []
    for step in steps:
        done = subprocess.run([*pip, *step], capture_output=True, text=True, check=False)
        if done.returncode:
            raise RefusedError(f"pip: {done.stderr.strip()[-160:]}")
    return python


def installed_mb(python: Path) -> float:
    """Return the size [MB] of the packages installed for `python`, except pip and setuptools, unneeded in flight."""
    found = 0
    for path in (python.parent.parent / "lib").rglob("*"):
        parts = path.parts[path.parts.index("site-packages") + 1 :] if "site-packages" in path.parts else ()
        tool = bool(parts) and parts[0].split("-")[0] in ("pip", "setuptools", "pkg_resources", "_distutils_hack")
        if path.is_file() and not path.is_symlink() and not tool:
            found += path.stat().st_size
    return found / 1e6


def fly(python: Path, folder: Path) -> dict[str, float]:
    """Fly one drone; return its estimator's peak resident memory [MB] and CPU ms per simulated second.

    Raises:
        RefusedError: the estimator failed, or did not finish in time.
    """
    (short_s, _), (long_s, resident) = (_flown(python, folder, seconds) for seconds in (SHORT_S, LONG_S))
    return {"resident_mb": resident, "cpu_ms_per_simulated_s": 1e3 * (long_s - short_s) / (LONG_S - SHORT_S)}


def _flown(python: Path, folder: Path, seconds: float) -> tuple[float, float]:
    """Return the estimator's CPU seconds and peak resident memory [MB] in a flight."""
    scenario = folder / "onboard.yaml"
    grid.write(scenario, 1, seconds, cluster=0, expect=["estimator.drone1"])
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    world = _quiet([*CLI, "world", str(scenario), "--listen", endpoint], folder)
    command = [str(python), "-m", "zsim_deploy.cli", "estimator", "drone1", "--connect", endpoint]
    estimator = _quiet(command, folder)
    try:
        return _watched(estimator)
    finally:
        for process in (estimator, world):
            process.kill()
            process.wait()


def _quiet(command: Sequence[str], folder: Path) -> subprocess.Popen[bytes]:
    """Start a process outside the project's folder, so that it imports the installed package."""
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _watched(estimator: subprocess.Popen[bytes]) -> tuple[float, float]:
    seen, resident, spent = psutil.Process(estimator.pid), 0.0, 0.0
    until_s = time.monotonic() + TIMEOUT_S
    while estimator.poll() is None:
        if time.monotonic() > until_s:
            raise RefusedError(f"estimator: not finished after {TIMEOUT_S:g} s")
        try:
            resident = max(resident, seen.memory_info().rss / 1e6)
            times = seen.cpu_times()
            spent = max(spent, times.user + times.system)
        except psutil.NoSuchProcess:
            break
        time.sleep(0.02)
    if estimator.wait():
        raise RefusedError(f"estimator: exit code {estimator.returncode}")
    return spent, resident
