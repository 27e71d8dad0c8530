"""Part f: flights of Test 1 per hour on two cores."""

import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from benchmarks import peers
from benchmarks.child import RefusedError, Server
from benchmarks.monte_carlo import way, zsim_sweep
from benchmarks.sheet import Progress, Sheet
from benchmarks.table import figure, spread, table

WORKERS = 2  # number of processes, each on a core of its own
RUNS = 12  # number of runs in zsim's sweep
TIMEOUT_S = 300.0  # ample, as the first flight includes compilation


class Contender(NamedTuple):
    """A contender: how to run it, what it flies and lacks; `peer` is None if it runs in zsim's own environment."""

    label: str
    peer: str | None
    module: str
    options: tuple[str, ...]
    flown: str
    lacks: str


CONTENDERS = {
    "zsim_fleet": Contender(
        "zsim's world alone, position controller", None, "zsim_fleet", ("--flights", "4"),
        "4 flights, one after the other",
        "estimators, cluster controller, messages, table"),
    "crazyflow": Contender(
        "crazyflow, position controller", "crazyflow", "crazyflow_worlds",
        ("--worlds", "256", "--seconds", "110"),
        "110 s of 256 flights at once, compiled as one loop, scaled up",
        "sensors, estimators, cluster controller, wind, contacts"),
    "rotorpy_batch": Contender(
        "RotorPy, batch on torch, SE(3) controller", "torch", "rotorpy_flights",
        ("--batch", "--flights", "1000", "--seconds", "1"),
        "1 s of 1000 flights at once (it keeps every step in memory), scaled up",
        "sensors but the IMU, estimators, cluster controller, contacts"),
    "pybullet": Contender(
        "gym-pybullet-drones on pybullet, PID controller", "pybullet", "pybullet_pid", ("--seconds", "110"),
        "110 s of a flight, scaled up",
        "sensors, estimators, cluster controller, wind, rotor lag"),
    "rotorpy": Contender(
        "RotorPy, `Environment`, SE(3) controller, wind EKF", "rotorpy", "rotorpy_flights", ("--seconds", "3"),
        "3 s of a flight, scaled up",
        "GPS, compass, sonar, position estimator, cluster controller, contacts"),
}  # fmt: skip
NOT_FLOWN = {"MuJoCo": "it has no multirotor controller; its bodies alone are in (b)"}


def measure(repeats: int) -> Sheet:
    """Fly Test 1 once for its paths, start the contenders, and let them fly in turn."""
    sheet = Sheet("f", f"runs per hour on {WORKERS} cores", notes={"sweep_runs": RUNS})
    sheet.refused = {name: why for name, c in CONTENDERS.items() if c.peer and (why := peers.missing(c.peer))}
    running = [name for name in CONTENDERS if name not in sheet.refused]
    progress = Progress("f", len(running) + repeats * (1 + len(running)))
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / "way.npz"
        way.write(zsim_sweep.flown_way(), path)  # also compiles the kernels before anything is timed
        crews = {name: _crew(stack, CONTENDERS[name], path) for name in running}
        for name, crew in crews.items():
            progress.tell(f"{CONTENDERS[name].label}, warm-up: {_flown(Sheet('f', ''), name, crew, 0)}")
        for number in range(1, repeats + 1):
            progress.tell(f"zsim sweep: {_swept(sheet)}")
            for name, crew in crews.items():
                progress.tell(f"{CONTENDERS[name].label}: {_flown(sheet, name, crew, number)}")
    return sheet


def _crew(stack: ExitStack, contender: Contender, path: Path) -> list[Server]:
    python = str(peers.PYTHON) if contender.peer else sys.executable
    command = [python, "-m", f"benchmarks.monte_carlo.{contender.module}", str(path)]
    crew = [Server([*command, str(worker), *contender.options]) for worker in range(WORKERS)]
    for server in crew:
        stack.callback(server.close)
    return crew


def _swept(sheet: Sheet) -> str:
    try:
        found = zsim_sweep.fly(RUNS, WORKERS)
    except RefusedError as error:
        return sheet.refuse("zsim", WORKERS, str(error), ["zsim", "zsim_cpu_s"])
    sheet.add("zsim_closest_m", WORKERS, found["closest_m"])
    return _noted(sheet, "zsim", RUNS, found["wall_s"], found["cpu_s"])


def _flown(sheet: Sheet, name: str, crew: list[Server], seed: int) -> str:
    """Let all processes of a contender fly at once and wait for the last; skip a contender that has failed before."""
    if why := sheet.refused.get(f"{name}@{WORKERS}"):
        return sheet.refuse(name, WORKERS, why, [name, f"{name}_cpu_s"])
    start_s = time.perf_counter()
    with ThreadPoolExecutor(len(crew)) as asking:
        asked = [asking.submit(server.ask, {"seed": seed}, TIMEOUT_S) for server in crew]
    wall_s = time.perf_counter() - start_s
    try:
        answers = [each.result() for each in asked]
    except RefusedError as error:
        return sheet.refuse(name, WORKERS, str(error), [name, f"{name}_cpu_s"])
    sheet.add(f"{name}_rms_m", WORKERS, max(answer["rms_m"] for answer in answers))
    sheet.add(f"{name}_closest_m", WORKERS, min(answer["closest_m"] for answer in answers))
    flights, cpu_s = (sum(answer[what] for answer in answers) for what in ("flights", "cpu_s"))
    return _noted(sheet, name, flights, wall_s, cpu_s)


def _noted(sheet: Sheet, name: str, flights: float, wall_s: float, cpu_s: float) -> str:
    sheet.add(name, WORKERS, 3600.0 * flights / wall_s)
    sheet.add(f"{name}_cpu_s", WORKERS, cpu_s / flights)
    return f"{3600.0 * flights / wall_s:.0f} runs per hour, {cpu_s / flights:.3g} CPU s each"


def page(sheet: Sheet) -> str:
    sweep = f"{sheet.notes['sweep_runs']} runs, start-up included"
    rows = [_row(sheet, "zsim", "`zsim sweep`, all of Test 1", sweep)]
    rows += [_row(sheet, name, contender.label, contender.flown) for name, contender in CONTENDERS.items()]
    lacks = [[contender.label, contender.lacks] for contender in CONTENDERS.values()]
    lacks += [[name, f"not flown: {why}"] for name, why in NOT_FLOWN.items()]
    head = ["", "runs per hour", "× `zsim sweep`", "CPU s per run", "off its path, m", "closest pair, m", "measured"]
    return "\n\n".join([table(head, rows), table(["", "leaves out"], lacks), _ratios(sheet)])


def _row(sheet: Sheet, name: str, label: str, flown: str) -> list[str]:
    hourly = sheet.spread(name, WORKERS)
    if not hourly:
        why = sheet.refused.get(name) or sheet.refused.get(f"{name}@{WORKERS}", "left out")
        return [label, f"not measured: {why}", *[""] * 5]
    ratio = "1" if name == "zsim" else spread(sheet.ratio(name, "zsim", WORKERS))
    medians = [sheet.spread(f"{name}_{what}", WORKERS) for what in ("rms_m", "closest_m")]
    shown = [figure(found.median) if found else "–" for found in medians]
    return [label, spread(hourly), ratio, spread(sheet.spread(f"{name}_cpu_s", WORKERS)), *shown, flown]


def _ratios(sheet: Sheet) -> str:
    """Return a table of the ratios of zsim to the only peer with an estimator, and of its world alone to the others."""
    pairs = {
        "`zsim sweep` / RotorPy with its estimator": ("zsim", "rotorpy"),
        "zsim's world alone / gym-pybullet-drones": ("zsim_fleet", "pybullet"),
        "zsim's world alone / RotorPy's batch": ("zsim_fleet", "rotorpy_batch"),
        "zsim's world alone / crazyflow": ("zsim_fleet", "crazyflow"),
    }
    rows = [
        [
            text,
            spread(sheet.ratio(ours, theirs, WORKERS)),
            spread(sheet.ratio(f"{theirs}_cpu_s", f"{ours}_cpu_s", WORKERS)),
        ]
        for text, (ours, theirs) in pairs.items()
    ]
    return table(["", "runs per hour", "runs per CPU second"], rows)
