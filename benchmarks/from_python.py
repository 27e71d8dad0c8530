"""Part j: overhead of the Python interface: a flight by `zsim.run` compared with `zsim run`, and stepped flights.

The flights of the comparison alternate, each in a separate process; both record, and neither makes a report. Stepped
flights are measured in CPU time of their process, excluding the first simulated second; they read only the truth.
"""

import gc
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.child import RefusedError
from benchmarks.sheet import Progress, Sheet
from benchmarks.table import spread, table

ROOT = Path(__file__).parents[1]
SCENARIO = ROOT / "scenarios" / "step.yaml"
DRONES = 3  # number of drones in the scenario
SECONDS = 120.0  # simulated duration of a flight
GATES = 20_000  # measured gates of a stepped flight
WARM_GATES = 50
COMMAND, PYTHON = "zsim run --in-process", "zsim.run"
STEPS = {
    "world alone": ("agents=None", False),
    "world alone, a new command to every drone": ("agents=None", True),
    "with the scenario's agents": ("agents='stock'", False),
}
RATIO_MAX, LEAST_GATES = 1.05, 8_000  # goals: at most this ratio, at least this many gates per CPU second


def measure(repeats: int) -> Sheet:
    sheet, progress = Sheet("j", "s, gates per CPU s"), Progress("j", repeats * (2 + len(STEPS)))
    for _ in range(repeats):
        for name, flown in ((COMMAND, _by_command), (PYTHON, _by_python)):
            with tempfile.TemporaryDirectory() as folder:
                sheet.add(name, DRONES, _wall_s(flown(Path(folder) / "run")))
            progress.tell(name)
        for name, (agents, commanded) in STEPS.items():
            said = _said([sys.executable, "-m", "benchmarks.from_python", agents, str(commanded)])
            sheet.add(name, DRONES, float(said))
            progress.tell(name)
    return sheet


def page(sheet: Sheet) -> str:
    walls = [[name, spread(sheet.spread(name, DRONES))] for name in (COMMAND, PYTHON)]
    medians = [found.median for name in (COMMAND, PYTHON) if (found := sheet.spread(name, DRONES))]
    ratio = f"`{PYTHON}` takes {medians[1] / medians[0]:.3f} times as long as the command (aim: at most {RATIO_MAX:g})."
    steps = [[name, spread(sheet.spread(name, DRONES))] for name in STEPS]
    return "\n\n".join(
        (
            f"A flight of {SECONDS:g} s of `scenarios/step.yaml`, start and end of the process included; {ratio}",
            table(["", "wall s"], walls),
            f"`Simulation.step`, {DRONES} drones (aim, world alone: at least {LEAST_GATES}):",
            table(["", "gates per CPU second"], steps),
        )
    )


def _by_command(out: Path) -> list[str]:
    command = [sys.executable, "-P", "-m", "zsim_deploy", "run", str(SCENARIO), "--in-process", "--no-report"]
    return [*command, "--duration", str(SECONDS), "--out", str(out)]


def _by_python(out: Path) -> list[str]:
    return [sys.executable, "-c", f"import zsim; zsim.run({str(SCENARIO)!r}, duration_s={SECONDS}, out={str(out)!r})"]


def _wall_s(command: list[str]) -> float:
    start_s = time.perf_counter()
    _said(command)
    return time.perf_counter() - start_s


def _said(command: list[str]) -> str:
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if ended.returncode:
        raise RefusedError(f"{command[-1]}: exit code {ended.returncode}: {ended.stderr.strip()[-160:]}")
    return ended.stdout


def stepped(agents: Any, is_commanded: bool, wrap: Callable[[Callable[[], None]], None] = lambda fly: fly()) -> float:
    """Return the gates per CPU second of a stepped flight; `wrap` calls the measured part, e.g. under a profiler."""
    import zsim

    sim = zsim.Simulation(SCENARIO, agents=agents, duration_s=3600)
    takeoff = dict.fromkeys(sim.names, zsim.takeoff())
    for gate in range(WARM_GATES):
        sim.step(takeoff if gate == 0 and is_commanded else {})

    def fly() -> None:
        total = 0.0
        for gate in range(GATES):
            commands = {name: zsim.velocity(0.1, 0.0, 0.001 * (gate % 7)) for name in sim.names} if is_commanded else {}
            total += sim.step(commands).position_m[0, 2]

    gc.collect()
    start_s = time.process_time()
    wrap(fly)
    return GATES / (time.process_time() - start_s)


if __name__ == "__main__":
    print(stepped({"agents=None": None, "agents='stock'": "stock"}[sys.argv[1]], sys.argv[2] == "True"))
