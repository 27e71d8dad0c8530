"""Where and with what a benchmark ran."""

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

OURS = ("eclipse-zenoh", "filterpy", "llvmlite", "msgspec", "numba", "numpy", "scipy")


def describe() -> dict[str, Any]:
    """Return processor, cores, load, Python, packages, and the time of asking."""
    versions = {found.name.lower(): found.version for found in distributions()}
    return {
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "system": f"{platform.system()} {platform.release()}",
        "python": sys.version.split()[0],
        "packages": {name: versions[name] for name in OURS if name in versions},
        "commit": _commit(),
    }


def line(machine: dict[str, Any]) -> str:
    """Return it as a line of text."""
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    load = " / ".join(f"{value:g}" for value in machine["load_average"])
    return (
        f"{machine['processor']}, {machine['cores']} cores, {machine['system']}, Python {machine['python']}, "
        f"{packages}; {machine['utc'][:10]}, load average at the start {load}."
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((text.split(":", 1)[1].strip() for text in lines if text.startswith("model name")), "unknown")


def _commit() -> str:
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip()
