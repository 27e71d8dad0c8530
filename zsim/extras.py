"""Extras of this distribution: which one brings a module that is missing, and how it is installed."""

import os
import sys
from collections.abc import Iterable
from pathlib import Path

# Which extra of pyproject.toml brings a module, by the name that is imported; of several the smallest.
EXTRA_OF = {
    "aiohttp": "gateway",
    "asyncssh": "hosts",
    "av": "video",
    "cryptography": "hosts",
    "cv2": "cameras",
    "distributed": "dask",
    "filterpy": "agents",
    "foxglove": "export",
    "jinja2": "report",
    "matplotlib": "report",
    "mcap": "record",
    "numba": "agents",
    "pandas": "notebook",
    "pyarrow": "export",
    "rosbags": "ros2",
    "scipy": "agents",
    "viser": "console",
    "xxhash": "ros2",
    "zstandard": "record",
}


def install_command(extras: Iterable[str]) -> str:
    """Return what to type for some extras of pyproject.toml: no index has zsim, a checkout of it has."""
    names = ",".join(sorted(set(extras)))
    checkout = Path(__file__).parents[1]
    if not (checkout / "pyproject.toml").exists():
        return f"pip install '.[{names}]' in a checkout of zsim"
    return f"{_shortest(sys.executable)} -m pip install -e '{_shortest(str(checkout))}[{names}]'"


def missing(error: ModuleNotFoundError) -> str | None:
    """Return a line on a module that an extra brings, with what to type; None if no extra brings it."""
    module = (error.name or "").partition(".")[0]
    extra = EXTRA_OF.get(module)
    return f"{module} is not installed; {install_command([extra])}" if extra else None


def _shortest(path: str) -> str:
    """Return a path inside the current folder relative to it, any other as it is."""
    inside = os.path.relpath(path)
    return path if inside.startswith("..") else inside
