"""Part g: throughput and latency of the gateway, compared with a bare aiohttp server and with plain Zenoh."""

import json
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from benchmarks.child import RefusedError, Server, result
from benchmarks.exchange.lap import free_port
from benchmarks.sheet import Progress, Sheet
from benchmarks.table import spread, table

SIZE = 1  # number of drones; irrelevant, as no measured message concerns a drone
SECONDS = 2.0  # wall time of each measurement
TIMEOUT_S = 120.0
SCENARIO = """
name: doors
duration_s: 3600
drones: [{name: drone1, position_m: [0, 0, 0]}]
processes: {expect: [nobody.yet]}
"""
"""Scenario of a world that stands still, as the expected process never joins: only the gateway is measured."""
LABELS = {
    "get": "zsim gateway, GET of a last value",
    "bare_get": "bare aiohttp, GET",
    "put": "zsim gateway, PUT on a key",
    "bare_put": "bare aiohttp, PUT",
    "trip": "zsim gateway, lines: `latest` and its answer",
    "lines": "Zenoh to a client of the gateway (lines)",
    "zenoh": "Zenoh to a client of Zenoh",
}
QUANTILES = ("p50", "p99")
COMPARED = (("get", "bare_get"), ("put", "bare_put"), ("lines", "zenoh"))


class Ports(NamedTuple):
    world: int
    http: int
    lines: int
    bare: int


def measure(repeats: int) -> Sheet:
    sheet = Sheet("g", "messages/s and ms")
    progress = Progress("g", repeats * len(LABELS))
    with _standing() as ports:
        for _ in range(repeats):
            for name in LABELS:
                progress.tell(_taken(sheet, name, ports))
            for quantile in QUANTILES:
                lines, bare = (sheet.values[f"{name}_{quantile}"][SIZE][-1] for name in ("lines", "zenoh"))
                sheet.add(f"added_{quantile}", SIZE, lines - bare if lines is not None and bare is not None else None)
    return sheet


def _taken(sheet: Sheet, name: str, ports: Ports) -> str:
    what = name.removeprefix("bare_")
    port = ports.bare if what != name else ports.http if what in ("get", "put") else ports.lines
    try:
        found = _client(what, port, "--endpoint", f"tcp/127.0.0.1:{ports.world}")
    except RefusedError as error:
        return sheet.refuse(name, SIZE, str(error), [f"{name}_{field}" for field in ("rate", *QUANTILES)])
    for field, value in found.items():
        sheet.add(f"{name}_{field}", SIZE, value)
    return f"{LABELS[name]}: {found['rate']:.0f} /s, p50 {found['p50']:.2f} ms"


def _client(what: str, port: int, *more: str) -> dict[str, float]:
    module = "benchmarks.doors.client"
    options = [what, "--port", str(port), "--seconds", str(SECONDS), *more]
    return result([sys.executable, "-m", module, *options], TIMEOUT_S)


@contextmanager
def _standing() -> Iterator[Ports]:
    """Run a world that stands still, its gateway and a bare aiohttp server; yield their ports."""
    ports = Ports(*(free_port() for _ in Ports._fields))
    zsim, endpoint = (sys.executable, "-m", "zsim_deploy.cli"), f"tcp/127.0.0.1:{ports.world}"
    doors = ("--http", str(ports.http), "--lines", str(ports.lines), "--connect", endpoint)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "doors.yaml"
        path.write_text(SCENARIO)
        started = [
            Server([*zsim, "world", str(path), "--listen", endpoint]),
            Server([*zsim, "gateway", *doors]),
            Server([sys.executable, "-m", "benchmarks.doors.echo", str(ports.bare)]),
        ]
        try:
            _await(f"http://127.0.0.1:{ports.http}/json/clock")
            _await(f"http://127.0.0.1:{ports.bare}/json/clock")
            yield ports
        finally:
            for server in started:
                server.close()


def _await(url: str) -> None:
    until_s = time.monotonic() + TIMEOUT_S
    while True:
        try:
            with urllib.request.urlopen(url) as answer:
                json.load(answer)
                return
        except OSError:
            if time.monotonic() > until_s:
                raise
            time.sleep(0.1)


def page(sheet: Sheet) -> str:
    fields = ("rate", *QUANTILES)
    rows = [
        [label, *(spread(sheet.spread(f"{name}_{field}", SIZE)) for field in fields)] for name, label in LABELS.items()
    ]
    for ours, theirs in COMPARED:
        cells = [spread(sheet.ratio(f"{ours}_{field}", f"{theirs}_{field}", SIZE)) for field in fields]
        rows.append([f"ratio: {LABELS[ours]} / {LABELS[theirs]}", *cells])
    added = [spread(sheet.spread(f"added_{quantile}", SIZE)) for quantile in QUANTILES]
    rows.append(["added by the gateway between Zenoh and a lines client [ms]", "", *added])
    return table(["", "per second", "p50 [ms]", "p99 [ms]"], rows)
