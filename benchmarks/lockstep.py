"""Part a: steps per second of a world and N agents that do nothing but wait for each other."""

import sys
from typing import NamedTuple

from benchmarks import peers
from benchmarks.child import RefusedError, result
from benchmarks.sheet import Progress, Sheet, spread
from benchmarks.table import PICTURES, lines, ratios, table
from benchmarks.table import spread as shown

SIZES = (1, 3, 5, 10)
SECONDS = 0.8  # wall time of each measurement
TIMEOUT_S = 60.0
HELICS = ("helics_tcp", "helics_zmq", "helics_ipc", "helics_zmq_ss")


class Contender(NamedTuple):
    """A contender: its name and how it is run; `peer` is None if it runs in zsim's own environment."""

    label: str
    peer: str | None
    module: str
    options: tuple[str, ...] = ()


CONTENDERS = {
    "zsim": Contender("zsim", None, "zsim_barrier"),
    "zsim_lookahead": Contender("zsim, lookahead of a gate", None, "zsim_barrier", ("--lookahead",)),
    "zsim_low_latency": Contender("zsim, LowLatency transport", None, "zsim_barrier", ("--low-latency",)),
    "zenoh_queue": Contender("bare Zenoh, queue", None, "bare_zenoh", ("--receive", "queue")),
    "zenoh_drain": Contender("bare Zenoh, drain", None, "bare_zenoh", ("--receive", "drain")),
    "zenoh_express": Contender("bare Zenoh, drain, express", None, "bare_zenoh", ("--express",)),
    "zenoh_low_latency": Contender("bare Zenoh, drain, LowLatency", None, "bare_zenoh", ("--low-latency",)),
    "zmq": Contender("pyzmq ROUTER/DEALER", "pyzmq", "zmq_router"),
    "zmq_lookahead": Contender("pyzmq, lookahead of a step", "pyzmq", "zmq_router", ("--lookahead",)),
    "raw_tcp": Contender("raw TCP", None, "raw_tcp"),
    "helics_tcp": Contender("HELICS, tcp", "helics", "helics_federation", ("--core", "tcp")),
    "helics_zmq": Contender("HELICS, zmq", "helics", "helics_federation", ("--core", "zmq")),
    "helics_ipc": Contender("HELICS, ipc", "helics", "helics_federation", ("--core", "ipc")),
    "helics_zmq_ss": Contender("HELICS, zmq_ss", "helics", "helics_federation", ("--core", "zmq_ss")),
    "mosaik": Contender("mosaik", "mosaik", "mosaik_simulators"),
}
LABELS = {name: contender.label for name, contender in CONTENDERS.items()}


def measure(repeats: int, sizes: tuple[int, ...] = SIZES, seconds: float = SECONDS) -> Sheet:
    sheet = Sheet("a", "steps/s")
    sheet.refused = {name: why for name, c in CONTENDERS.items() if c.peer and (why := peers.missing(c.peer))}
    running = [name for name in CONTENDERS if name not in sheet.refused]
    progress = Progress("a", repeats * len(sizes) * len(running))
    for _ in range(repeats):
        for size in sizes:
            for name in running:
                progress.tell(f"{LABELS[name]}, N = {size}: {_measured(sheet, name, size, seconds)}")
    return sheet


def _measured(sheet: Sheet, name: str, size: int, seconds: float) -> str:
    try:
        rate = result(command(CONTENDERS[name], size, seconds), TIMEOUT_S)["steps_per_s"]
    except RefusedError as error:
        return sheet.refuse(name, size, str(error), [name])
    sheet.add(name, size, rate)
    return f"{rate:.0f} steps/s"


def command(contender: Contender, size: int, seconds: float) -> list[str]:
    python = str(peers.PYTHON) if contender.peer else sys.executable
    module = f"benchmarks.exchange.{contender.module}"
    return [python, "-m", module, "--agents", str(size), "--seconds", str(seconds), *contender.options]


def page(sheet: Sheet) -> str:
    lines(sheet, LABELS, PICTURES / "bench_a.svg", "Lockstep with nothing to compute", "agents")
    return "\n\n".join([ratios(sheet, LABELS, "zsim"), _goals(sheet), "![steps per second](results/bench_a.svg)"])


def _goals(sheet: Sheet) -> str:
    sizes = sheet.sizes()
    rows = [["zsim / HELICS at its best core, goal ≥ 2", *(_against_best(sheet, size) for size in sizes)]]
    for name, text in (("zmq", "zsim / pyzmq, goal ≥ 0.85"), ("zenoh_queue", "zsim / bare Zenoh, queue"),
                       ("mosaik", "zsim / mosaik"), ("raw_tcp", "zsim / raw TCP")):  # fmt: skip
        rows.append([text, *(shown(sheet.ratio("zsim", name, size)) for size in sizes)])
    both = [sheet.ratio("zsim_lookahead", "zmq_lookahead", size) for size in sizes]
    rows.append(["zsim / pyzmq, both with lookahead", *map(shown, both)])
    return table(["", *(f"N = {size}" for size in sizes)], rows)


def _against_best(sheet: Sheet, size: int) -> str:
    """Return zsim's rate divided by that of each repeat's fastest HELICS core, as a table cell."""
    mine = sheet.values.get("zsim", {}).get(size, [])
    cores = [values for name in HELICS if (values := sheet.values.get(name, {}).get(size))]
    best = [max((value for value in values if value), default=None) for values in zip(*cores, strict=False)]
    return shown(spread([a / b if a and b else None for a, b in zip(mine, best, strict=False)]))
