"""Measure an in-process run: its CPU time after the first simulated second, and its memory; print a line of JSON.

.venv/bin/python -m benchmarks.flight --drones 10 --seconds 5
"""

import argparse
import gc
import json
import tempfile
import time
from pathlib import Path

import psutil

from benchmarks import grid
from zsim.record import RecordWriter
from zsim_analysis.in_process import InProcessFlight

WARM_NS = 1_000_000_000  # simulated warm-up, not measured


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drones", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0, help="simulated")
    given = parser.parse_args()
    print(json.dumps(fly(given.drones, given.seconds)), flush=True)


def fly(drones: int, seconds: float) -> dict[str, float]:
    """Return CPU seconds per simulated second, and resident memory at the end [MB], by name."""
    flight = InProcessFlight(grid.scenario(drones, duration_s=WARM_NS / 1e9 + seconds))
    world = flight.world
    with tempfile.TemporaryDirectory() as folder:
        writer = RecordWriter(Path(folder) / "run.mcap")
        flight.start([writer])
        gc.collect()
        gc.freeze()  # as `zsim run --in-process` does
        while world.now_ns < WARM_NS:
            flight.turn()
        start_s, start_ns = time.process_time(), world.now_ns
        while flight.turn():
            pass
        cpu_s = time.process_time() - start_s
        simulated_s = (world.now_ns - start_ns) / 1e9
        resident = psutil.Process().memory_info().rss / 1e6
        flight.end()
        writer.close()
    return {"cpu_s_per_simulated_s": cpu_s / simulated_s, "resident_mb": resident}


if __name__ == "__main__":
    main()
