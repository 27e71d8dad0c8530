"""Measure the parts of the benchmarks; write the results to benchmarks/results and benchmarks/README.md.

make bench                                        all parts; creates the peers' environment first
.venv/bin/python -m benchmarks a b --repeats 7    some parts
.venv/bin/python -m benchmarks c --against REV    this working tree against another commit
.venv/bin/python -m benchmarks a --page           rewrite a section of the page from results/a.json, without measuring
"""

import argparse
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import (
    against,
    command_age,
    console,
    from_python,
    gateway,
    growth,
    kernels,
    lockstep,
    peers,
    real_time_factor,
    recorder,
    runs_per_hour,
    table,
)
from benchmarks.child import RefusedError
from benchmarks.sheet import Sheet, read

RESULTS = Path(__file__).parent / "results"
BESIDE = frozenset("abf")  # parts that compare zsim with peers


class Part(NamedTuple):
    """A part of the benchmarks: `measure` returns a sheet with a number of repeats, `page` renders it as Markdown."""

    measure: Callable[[int], Sheet]
    page: Callable[[Sheet], str]


PARTS = {
    "a": Part(lockstep.measure, lockstep.page),
    "b": Part(kernels.measure, kernels.page),
    "c": Part(real_time_factor.measure, real_time_factor.page),
    "d": Part(command_age.measure, command_age.page),
    "e": Part(growth.measure, growth.page),
    "f": Part(runs_per_hour.measure, runs_per_hour.page),
    "g": Part(gateway.measure, gateway.page),
    "h": Part(console.measure, console.page),
    "i": Part(recorder.measure, recorder.page),
    "j": Part(from_python.measure, from_python.page),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"one of {' '.join(PARTS)}; all if none is given")
    parser.add_argument("--repeats", type=int, default=5, help="number of repeats of every measurement (5)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON files")
    parser.add_argument("--page", action="store_true", help="measure nothing; rewrite sections from the JSON files")
    parser.add_argument("--no-page", action="store_true", help="leave benchmarks/README.md alone; draw pictures")
    parser.add_argument("--against", metavar="REV", help="with only part c: measure this tree and a commit in turn")
    parser.add_argument(
        "--of",
        nargs="+",
        choices=against.FLIGHTS,
        default=list(against.FLIGHTS),
        help="with --against: flights to make (all)",
    )
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # so that contenders are terminated too
    if unknown := set(given.parts) - set(PARTS):
        parser.error(f"part is {', '.join(sorted(unknown))}; must be one of {' '.join(PARTS)}")
    chosen = {name: PARTS[name] for name in given.parts or PARTS}
    if given.against is not None:
        if list(chosen) != ["c"]:
            parser.error(f"--against: part is {', '.join(chosen)}; must be only c: use c --against {given.against}")
        chosen = {"c-against": Part(partial(against.measure, revision=given.against, names=given.of), against.page)}
    if not given.page and BESIDE & set(chosen):
        peers.ensure(_say)
    for name, part in chosen.items():
        path = given.results / f"{name}.json"
        try:
            sheet = read(path) if given.page else _measured(name, part, given.repeats, path)
        except RefusedError as error:
            parser.error(str(error))
        told = f"{_where(sheet)}\n\n{part.page(sheet)}"
        if given.against is not None:
            print(told)
        if not given.no_page:
            table.update(name, told)


def _measured(name: str, part: Part, repeats: int, path: Path) -> Sheet:
    start_s, described = time.monotonic(), describe()
    sheet = part.measure(repeats)
    sheet.machine = {**described, "peers": peers.versions() if name in BESIDE else {}, "repeats": repeats}
    sheet.machine["minutes"] = round((time.monotonic() - start_s) / 60.0, 1)
    sheet.write(path)
    _say(f"{name}: {sheet.machine['minutes']} min, written to {path}")
    return sheet


def _where(sheet: Sheet) -> str:
    """Describe when, where and with what a sheet was measured."""
    others = ", ".join(f"{name} {version}" for name, version in sheet.machine["peers"].items())
    peers_told = f" Peers: {others}." if others else ""
    repeats = sheet.machine["repeats"]
    return f"{line(sheet.machine)}{peers_told} Medians of {repeats} (least to greatest)."


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


OURS = ("eclipse-zenoh", "llvmlite", "msgspec", "numba", "numpy", "scipy")


def describe() -> dict[str, Any]:
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


if __name__ == "__main__":
    main()
