"""The time that each role takes from its start until it is ready, and its memory at that time."""

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import psutil

from benchmarks import grid
from benchmarks.child import RefusedError
from benchmarks.exchange.lap import free_port
from benchmarks.run import CLI
from zsim.transport.connection import find_world

FEDERATION = "zsim"
PATIENCE_S = 60.0
LOOK_S = 0.002  # polling interval while a role starts
ROLES = {
    "world": "zsim world",
    "estimator": "zsim estimator",
    "controller": "zsim controller",
    "record": "zsim record",
    "router": "zsim router",
    "help": "zsim --help",
    "run": "zsim run",
}


def measure(folder: Path) -> dict[str, float]:
    """Return the seconds until ready as `{role}`, and the resident memory at that time as `{role}_mb` [MB].

    A world is ready when it answers `world/info`, a router when its port opens, the others when they have joined.
    `zsim --help`, and `zsim run` with six processes and one gate, are timed to their end.
    """
    found = {"help": _timed_to_end([*CLI, "--help"])}
    scenario = folder / "start_up.yaml"
    grid.write(scenario, 3, 10.0)
    run = ["run", str(scenario), "--duration", "0.02", "--no-report", "--out", str(folder / "run")]
    found["run"] = _timed_to_end([*CLI, *run])
    endpoint, router = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    reach = ["--connect", endpoint, "--federation", FEDERATION]
    start_s = time.perf_counter()
    with _running([*CLI, "world", str(scenario), "--listen", endpoint]) as world:
        _until(lambda: _opens(endpoint), world)
        with find_world(endpoint, FEDERATION, wait_s=PATIENCE_S, reader=True) as (link, _):
            _note(found, "world", start_s, world)
            joins = link.subscribe("process/*/join")
            for role, words in {
                "estimator": ["drone1"],
                "controller": ["c1"],
                "record": ["--out", str(folder)],
            }.items():
                start_s = time.perf_counter()
                with _running([*CLI, role, *reach, *words]) as process:
                    _until(lambda: any(True for _ in joins.drain()), process)
                    _note(found, role, start_s, process)
            start_s = time.perf_counter()
            with _running([*CLI, "router", "--listen", router, *reach]) as process:
                _until(lambda: _opens(router), process)
                _note(found, "router", start_s, process)
    return found


def _note(found: dict[str, float], role: str, start_s: float, process: subprocess.Popen[bytes]) -> None:
    found[role] = time.perf_counter() - start_s
    found[f"{role}_mb"] = psutil.Process(process.pid).memory_info().rss / 1e6


def _timed_to_end(command: Sequence[str]) -> float:
    start_s = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start_s


@contextmanager
def _running(command: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def _until(ready: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    """Wait until a process is ready; raise RefusedError if it ends or is not ready in time."""
    until_s = time.perf_counter() + PATIENCE_S
    while not ready():
        if process.poll() is not None:
            raise RefusedError(f"{process.args!r}: exit code {process.returncode}")
        if time.perf_counter() > until_s:
            raise RefusedError(f"{process.args!r}: not ready within {PATIENCE_S:g} s")
        time.sleep(LOOK_S)


def _opens(endpoint: str) -> bool:
    host, port = endpoint.removeprefix("tcp/").split(":")
    try:
        with socket.create_connection((host, int(port)), 1.0):
            return True
    except OSError:
        return False


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as temporary:
        print(measure(Path(temporary)), file=sys.stderr)
