"""zsim itself: `zsim sweep` as a user calls it, and a flight of Test 1 whose paths the peers follow."""

import resource
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from benchmarks.child import RefusedError
from benchmarks.monte_carlo.way import GATE_S, Way
from benchmarks.peers import ROOT
from benchmarks.run import CLI
from zsim.scenario import scenario_file
from zsim_analysis.sweep.sweep_run import fly_scenario

TEST_1 = ROOT / "scenarios" / "step.yaml"
TIMEOUT_S = 900.0


def fly(runs: int, workers: int, duration_s: float | None = None) -> dict[str, float]:
    """Fly a sweep over seeds; return wall and CPU seconds, start-up included, and the drones' closest approach.

    Raises:
        RefusedError: the sweep or one of its runs failed, or the sweep did not end in time.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "sweep"
        command = [*CLI, "sweep", str(TEST_1), "--runs", str(runs), "--vary", "seed", "--workers", str(workers)]
        command += ["--no-report", "--out", str(folder)]
        command += [] if duration_s is None else ["--duration", str(duration_s)]
        start_s, spent_s = time.perf_counter(), _children_cpu_s()
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired:
            raise RefusedError(f"zsim sweep: not finished after {TIMEOUT_S:g} s") from None
        found = {"wall_s": time.perf_counter() - start_s, "cpu_s": _children_cpu_s() - spent_s}
        if done.returncode:
            raise RefusedError(f"zsim sweep: exit code {done.returncode}: {done.stderr.strip()[-160:]}")
        return {**found, "closest_m": _closest_m(folder / "sweep.parquet")}


def _closest_m(path: Path) -> float:
    """Return the closest approach of two drones in any run of a sweep's table; raise RefusedError if a run failed."""
    rows = pq.read_table(path, columns=["failure", "min_separation_m"]).to_pylist()
    if failures := [row["failure"] for row in rows if row["failure"]]:
        raise RefusedError(f"zsim sweep: {len(failures)} of {len(rows)} runs failed: {failures[0]}"[:200])
    return min(row["min_separation_m"] for row in rows)


def flown_way(duration_s: float | None = None) -> Way:
    """Fly Test 1 with the scenario's seed for `duration_s` (None: to its end); return the drones' paths."""
    overrides = [] if duration_s is None else [f"duration_s={duration_s}"]
    flight, diverged = fly_scenario(scenario_file.load(TEST_1, overrides))
    if diverged:
        raise diverged
    gate_ns = round(GATE_S * 1e9)
    t_ns = np.arange(int(flight.tracks[0].t_ns[-1]) // gate_ns + 1) * gate_ns
    at = [np.searchsorted(track.t_ns, t_ns) for track in flight.tracks]
    truth = np.stack([track.truth[i] for track, i in zip(flight.tracks, at, strict=True)], axis=1)
    yaw = np.stack([track.yaw[i] for track, i in zip(flight.tracks, at, strict=True)], axis=1)
    return Way(truth[..., 0:3], truth[..., 3:6], yaw)


def _children_cpu_s() -> float:
    """Return user and system time of all child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
