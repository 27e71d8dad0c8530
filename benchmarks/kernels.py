"""Part b: drone-seconds simulated per CPU second with N drones in the air in one process."""

import sys
from contextlib import ExitStack
from typing import NamedTuple

from benchmarks import peers
from benchmarks.child import RefusedError, Server
from benchmarks.sheet import Progress, Sheet
from benchmarks.table import PICTURES, lines, ratios, table
from benchmarks.table import spread as shown

SIZES = (1, 3, 10, 100, 1000)
CPU_S = 0.4  # CPU time of each measurement
TIMEOUT_S = 240.0  # ample, as the first measurement includes compilation


class Contender(NamedTuple):
    """A contender: how to run it, its step, what it leaves out; `peer` is None if it runs in zsim's own environment."""

    label: str
    peer: str | None
    module: str
    options: tuple[str, ...]
    step: str
    lacks: str


NOTHING = "firmware, sensors, wind, contacts"
CONTENDERS = {
    "zsim": Contender("zsim", None, "zsim_fleet", (), "2.5 ms, RK4", "–"),
    "zsim_kernel": Contender("zsim, bare kernel", None, "zsim_fleet", ("--bare",), "2.5 ms, RK4", "noise generation"),
    "pybullet": Contender(
        "PyBullet, as used by gym-pybullet-drones", "pybullet", "pybullet_drones", (), "4.2 ms, semi-implicit Euler",
        "firmware, sensors, wind, rotor lag"),
    "rotorpy": Contender(
        "RotorPy, objects", "rotorpy", "rotorpy_bodies", (), "10 ms, RK45 adaptive", NOTHING),
    "rotorpy_batch": Contender(
        "RotorPy, batch on torch", "torch", "rotorpy_bodies", ("--batch",), "10 ms, RK4", NOTHING),
    "rotorpy_threads": Contender(
        "RotorPy, batch, all threads", "torch", "rotorpy_bodies", ("--batch", "--threads"), "10 ms, RK4", NOTHING),
    "crazyflow": Contender(
        "crazyflow, 20 ms a call", "crazyflow", "crazyflow_jax", (), "2.5 ms, Euler", "sensors, wind, contacts"),
    "crazyflow_long": Contender(
        "crazyflow, 1 s a call", "crazyflow", "crazyflow_jax", ("--long",), "2.5 ms, Euler", "sensors, wind, contacts"),
    "crazyflow_rk4": Contender(
        "crazyflow, 20 ms a call, RK4", "crazyflow", "crazyflow_jax", ("--rk4",), "2.5 ms, RK4",
        "sensors, wind, contacts"),
    "crazyflow_threads": Contender(
        "crazyflow, 20 ms a call, all threads", "crazyflow", "crazyflow_jax", ("--threads",), "2.5 ms, Euler",
        "sensors, wind, contacts"),
    "mujoco": Contender(
        "MuJoCo, one world", "mujoco", "mujoco_bodies", (), "2.5 ms, semi-implicit Euler", f"{NOTHING}, rotor lag"),
    "mujoco_apart": Contender(
        "MuJoCo, a world each", "mujoco", "mujoco_bodies", ("--apart",), "2.5 ms, semi-implicit Euler",
        f"{NOTHING}, rotor lag"),
}  # fmt: skip
LABELS = {name: contender.label for name, contender in CONTENDERS.items()}
PEERS = [name for name in CONTENDERS if not name.startswith("zsim")]


def measure(repeats: int, sizes: tuple[int, ...] = SIZES, cpu_s: float = CPU_S) -> Sheet:
    """Start all contenders and measure them in turn at every size."""
    sheet = Sheet("b", "drone-seconds per CPU second")
    sheet.refused = {name: why for name, c in CONTENDERS.items() if c.peer and (why := peers.missing(c.peer))}
    running = [name for name in CONTENDERS if name not in sheet.refused]
    progress = Progress("b", repeats * len(sizes) * len(running))
    with ExitStack() as stack:
        servers = {name: _started(stack, CONTENDERS[name]) for name in running}
        for _ in range(repeats):
            for size in sizes:
                for name, server in servers.items():
                    progress.tell(f"{LABELS[name]}, N = {size}: {_measured(sheet, name, server, size, cpu_s)}")
    return sheet


def _started(stack: ExitStack, contender: Contender) -> Server:
    python = str(peers.PYTHON) if contender.peer else sys.executable
    server = Server([python, "-m", f"benchmarks.kernel.{contender.module}", *contender.options])
    stack.callback(server.close)
    return server


def _measured(sheet: Sheet, name: str, server: Server, size: int, cpu_s: float) -> str:
    if f"{name}@{size}" in sheet.refused:
        sheet.add(name, size, None)
        return sheet.refused[f"{name}@{size}"]
    try:
        found = server.ask({"drones": size, "cpu_s": cpu_s}, TIMEOUT_S)["drone_s_per_cpu_s"]
    except RefusedError as error:
        return sheet.refuse(name, size, str(error), [name])
    sheet.add(name, size, found)
    return f"{found:.0f} drone-seconds per CPU second"


def page(sheet: Sheet) -> str:
    lines(sheet, LABELS, PICTURES / "bench_b.svg", "Drones in the air, no messages", "drones")
    steps = table(["", "step", "leaves out"], [[c.label, c.step, c.lacks] for c in CONTENDERS.values()])
    picture = "![drone-seconds per CPU second](results/bench_b.svg)"
    return "\n\n".join([ratios(sheet, LABELS, "zsim"), _goals(sheet), steps, picture])


def _goals(sheet: Sheet) -> str:
    sizes = sheet.sizes()
    best = {size: sheet.best(PEERS, size) for size in sizes}
    first = ["best of the others", *(LABELS[name] if name else "–" for name in best.values())]
    ahead = [shown(sheet.ratio("zsim", name, size)) if name else "–" for size, name in best.items()]
    rows = [first, ["zsim / best of the others, goal > 1 up to N = 100", *ahead]]
    for name, text in (("crazyflow", "zsim / crazyflow, goal ≥ 2 at N = 100"), ("crazyflow_rk4", "the same, both RK4")):
        rows.append([text, *(shown(sheet.ratio("zsim", name, size)) for size in sizes)])
    return table(["", *(f"N = {size}" for size in sizes)], rows)
