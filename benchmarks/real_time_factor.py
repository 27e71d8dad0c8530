"""How fast Test 1 flies, as processes and in one process, and which role spends what.

    .venv/bin/python benchmarks/real_time_factor.py [--repeats 3] [--seconds 120] [--json FILE]

Each repeat flies both, so that a busy machine slows both; medians are printed. A factor counts simulated seconds per
wall second between the first gate and the last, as `summary.json` does. CPU per role is read from the kernel while
the processes fly.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import msgspec
import psutil

from zsim import messages
from zsim.record import RecordReader

SCENARIO = Path(__file__).parent.parent / "scenarios" / "step.yaml"


def end_event(folder: Path) -> dict[str, float]:
    """Return what the world measured of its run."""
    records = RecordReader(folder / "run.mcap").messages(keys=["world/event"])
    events = [msgspec.msgpack.decode(record.payload, type=messages.Event) for record in records]
    return next(event.data for event in events if event.kind == "end")


def fly(seconds: float, *options: str) -> tuple[dict[str, float], dict[str, float]]:
    """Fly once; return the world's figures, and CPU seconds by role."""
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "run"
        command = [sys.executable, "-m", "zsim_deploy.cli", "run", str(SCENARIO), "--no-report"]
        command += ["--duration", str(seconds), "--out", str(out), *options]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        cpu: dict[str, float] = {}
        while process.poll() is None:
            cpu.update(cpu_by_role(process.pid))
            time.sleep(0.1)
        assert process.returncode == 0, f"exit code {process.returncode}"
        return end_event(out), cpu


def cpu_by_role(launcher: int) -> dict[str, float]:
    """Return user + system CPU seconds of the launcher and of each of its children."""
    found = {}
    try:
        parent = psutil.Process(launcher)
        for process in [parent, *parent.children()]:
            words = process.cmdline()[3:5]
            name = (
                "launcher" if process.pid == launcher else ".".join(w for w in words if "/" not in w and w[:2] != "--")
            )
            times = process.cpu_times()
            found[name] = times.user + times.system
    except psutil.NoSuchProcess:
        return found
    return found


def median(values: list[float]) -> float:
    return round(statistics.median(values), 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    fly(2.0)  # compiles what is not compiled yet
    together: list[float] = []
    apart: list[float] = []
    by_role: list[dict[str, float]] = []
    for number in range(given.repeats):
        apart_figures, cpu = fly(given.seconds)
        apart.append(apart_figures["real_time_factor"])
        by_role.append(cpu)
        together.append(fly(given.seconds, "--in-process")[0]["real_time_factor"])
        print(f"repeat {number + 1}: processes {apart[-1]:.1f}, one process {together[-1]:.1f}", file=sys.stderr)
    roles = {name: median([1e3 * cpu.get(name, 0.0) / given.seconds for cpu in by_role]) for name in by_role[0]}
    result = {
        "processes": median(apart),
        "in_process": median(together),
        "cpu_ms_per_simulated_s_with_start": roles,
        "simulated_s": given.seconds,
        "repeats": given.repeats,
    }
    print(json.dumps(result, indent=2))
    if given.json:
        given.json.write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
