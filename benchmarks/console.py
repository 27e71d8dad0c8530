"""Part h: the cost of the console: its share of a core, and by how much it slows a run in lockstep.

The share is the processor time of the console's process divided by wall time, with one page open: a client that reads
everything that a page is sent. The slowdown is the real-time factor with a console and such a client, divided by the
mean of the factors just before and just after; it is measured repeatedly within one run, because machines drift.
"""

import json
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import msgspec
import psutil
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from benchmarks import grid
from benchmarks.child import RefusedError
from benchmarks.exchange.lap import free_port
from benchmarks.sheet import Progress, Sheet
from benchmarks.table import figure, spread, table
from zsim.contract import keys, messages
from zsim.transport import connection
from zsim.transport.session import Session
from zsim_bridges.console.page_server import ViewerCamera

CLI = (sys.executable, "-m", "zsim_deploy.cli")
SIZES = (3, 50)  # drones
SECONDS = 15.0  # wall time over which the share of a core is measured
SETTLE_S = 5.0  # wall time before each measurement, since a newly opened page is sent everything at once
FLIGHT_S = 100_000.0  # simulated; the run of the real-time factors is ended long before this
WINDOW_S = 8.0  # wall time over which a real-time factor is measured
PAIRS = 8  # windows with a console per run, each between two without
TIMEOUT_S = 300.0
LOOK_S = 0.2
GOALS = {3: 15.0, 50: 60.0}  # maximum percentage of a core, by number of drones
PICTURES_HZ = {3: 20.0, 50: 10.0}  # picture rate of the console, by number of drones
LEAST_PICTURES = 0.8  # minimum share of these pictures; a starved console draws fewer and seems cheap
LEAST_RATE = 0.9  # minimum real-time factor; a slower run gives the console less to draw
DRONES = "/drones"  # node of the drones in viser's scene
CAMERA = ViewerCamera(  # first message of a page, before which viser ignores its controls
    (1.0, 0.0, 0.0, 0.0), (0.0, -5.0, 3.0), 1.0, 0.01, 1000.0, 600, 800, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
)


class Share(NamedTuple):
    """Measurements of a console over SECONDS."""

    percent: float  # processor time as a percentage of a core
    read_per_s: float  # bytes or pictures a second that reached the page
    factor: float  # simulated time / wall time


class Reader:
    """A client that reads everything that viser sends to a page, but draws nothing.

    Args:
        port: the console's port.

    Attributes:
        received: number of bytes received.
        pictures: number of updates of the drones received.
    """

    def __init__(self, port: int) -> None:
        import viser

        spoken = [Subprotocol(f"viser-v{viser.__version__}")]
        self._socket = connect(f"ws://127.0.0.1:{port}/", subprotocols=spoken, compression=None, max_size=None)
        self._socket.send(msgspec.msgpack.encode(CAMERA))
        self.received = 0
        self.pictures = 0
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with suppress(ConnectionClosed):
            for said in self._socket:
                self.received += len(said)
                self.pictures += _has_drones(said)

    def close(self) -> None:
        self._socket.close()
        self._thread.join()


def _has_drones(said: str | bytes) -> bool:
    """Return whether a viser message moves the drones; it consists of lengths, a packed part, and arrays."""
    assert isinstance(said, bytes)
    packed = said[16 : 16 + int.from_bytes(said[8:16], "little")]
    told = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed), strict=False)["messages"]
    return any(each.get("name") == DRONES and "batched_positions" in each.get("updates", ()) for each in told)


@contextmanager
def _started(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    quiet = subprocess.DEVNULL
    process = subprocess.Popen([*CLI, *arguments], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(TIMEOUT_S)


def _await(condition: Callable[[], bool], what: str) -> None:
    until_s = time.monotonic() + TIMEOUT_S
    while not condition():
        if time.monotonic() > until_s:
            raise RefusedError(f"{what} did not appear within {TIMEOUT_S:g} s")
        time.sleep(LOOK_S)


def _runs(port: int) -> bool:
    """Return whether the console shows more than 3 s of a run."""
    with suppress(OSError, KeyError):  # the page can be opened before it shows a run
        return _shown_s(port) > 3.0
    return False


@contextmanager
def _flying(folder: Path, count: int) -> Iterator[tuple[int, psutil.Process]]:
    """Fly `count` drones at 1 x real time with a console; yield the console's port and process."""
    scenario, world, port = folder / f"grid{count}.yaml", free_port(), free_port()
    grid.write(scenario, count, 3600.0)
    endpoint = f"tcp/127.0.0.1:{world}"
    run = ("run", str(scenario), "--listen", endpoint, "--hosted", "--rate", "1", "--no-report")
    with (
        _started(*run, "--out", str(folder / f"out{port}")),
        _started("console", "--connect", endpoint, "--port", str(port)) as console,
    ):
        _await(lambda: _runs(port), "a run on the console")
        yield port, psutil.Process(console.pid)


def _share(console: psutil.Process, port: int, read: Callable[[], int] = lambda: 0) -> Share:
    """Measure a console over SECONDS; `read` returns the bytes or pictures that have reached a page."""
    time.sleep(SETTLE_S)
    before, sent, simulated_s, start_s = console.cpu_times(), read(), _shown_s(port), time.monotonic()
    time.sleep(SECONDS)
    after, wall_s = console.cpu_times(), time.monotonic() - start_s
    spent_s = after.user + after.system - before.user - before.system
    return Share(100.0 * spent_s / wall_s, (read() - sent) / wall_s, (_shown_s(port) - simulated_s) / wall_s)


def _shown_s(port: int) -> float:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/state", timeout=5.0) as answer:
        return float(json.load(answer)["t_s"])


def _measure_shares(sheet: Sheet, folder: Path, count: int) -> str:
    with _flying(folder, count) as (port, console):
        alone = _share(console, port)
        reader = Reader(port)
        try:
            sent = _share(console, port, lambda: reader.received)
            drawn = _share(console, port, lambda: reader.pictures)
        finally:
            reader.close()
    _check_kept_up(count, drawn)
    sheet.add("alone", count, alone.percent)
    sheet.add("read", count, (sent.percent + drawn.percent) / 2)
    sheet.add("rate", count, sent.read_per_s / 1000.0)
    return f"{count} drones: {sheet.values['read'][count][-1]:.1f} % of a core"


def _check_kept_up(count: int, drawn: Share) -> None:
    """Raise a RefusedError if too few pictures were drawn, or the run did not keep up with real time."""
    if drawn.read_per_s < LEAST_PICTURES * PICTURES_HZ[count] or drawn.factor < LEAST_RATE:
        found = f"{drawn.read_per_s:.1f} pictures a second at × {drawn.factor:.2f}"
        raise RefusedError(f"{count} drones: {found}; must be about {PICTURES_HZ[count]:g} at × 1")


def _measure_factors(sheet: Sheet, folder: Path, count: int) -> str:
    """Fly one run unpaced, with and without a console in turn, and add its real-time factors to the sheet."""
    scenario, world = folder / f"fast{count}.yaml", free_port()
    endpoint = f"tcp/127.0.0.1:{world}"
    grid.write(scenario, count, FLIGHT_S)
    run = ("run", str(scenario), "--listen", endpoint, "--hosted", "--no-report", "--out", str(folder / f"out{world}"))
    with _started(*run), connection.connect(endpoint, "zsim", wait_s=TIMEOUT_S, reader=True) as link:
        _await(lambda: _now_s(link) > 1.0, "the run")
        before = _factor(link)
        for _ in range(PAIRS):
            with _looked_at(endpoint):
                shown = _factor(link)
            after = _factor(link)
            sheet.add("without", count, (before + after) / 2)
            sheet.add("with", count, shown)
            before = after
    return f"{count} drones: {spread(sheet.ratio('with', 'without', count))} of the real-time factor"


@contextmanager
def _looked_at(endpoint: str) -> Iterator[None]:
    """Run a console and a client that reads everything that a page is sent."""
    port = free_port()
    with _started("console", "--connect", endpoint, "--port", str(port)):
        _await(lambda: _runs(port), "a run on the console")
        reader = Reader(port)
        try:
            yield
        finally:
            reader.close()


def _factor(link: Session) -> float:
    time.sleep(SETTLE_S)
    simulated_s, start_s = _now_s(link), time.monotonic()
    time.sleep(WINDOW_S)
    return (_now_s(link) - simulated_s) / (time.monotonic() - start_s)


def _now_s(link: Session) -> float:
    """Return the simulated time of a run [s], or 0 before its clock is published."""
    found = link.get(keys.CLOCK)
    return messages.decode(keys.CLOCK, found[0].payload).t_ns / 1e9 if found else 0.0


def measure(repeats: int) -> Sheet:
    sheet = Sheet("h", "% of a core, and × real time")
    progress = Progress("h", 2 * repeats * len(SIZES))
    with tempfile.TemporaryDirectory() as temporary:
        for _ in range(repeats):
            for count in SIZES:
                progress.tell(_measure_shares(sheet, Path(temporary), count))
                progress.tell(_measure_factors(sheet, Path(temporary), count))
    return sheet


def page(sheet: Sheet) -> str:
    rows = [
        ["no page open [% of a core]", *_cells(sheet, "alone")],
        ["one page open [% of a core]", *_cells(sheet, "read")],
        ["goal for one page [% of a core]", *(f"≤ {figure(GOALS[count])}" for count in SIZES)],
        ["sent to a page [kB/s]", *_cells(sheet, "rate")],
        ["as fast as it goes, without a console [× real time]", *_cells(sheet, "without")],
        ["as fast as it goes, with one page [× real time]", *_cells(sheet, "with")],
        ["ratio, window by window", *(spread(sheet.ratio("with", "without", count)) for count in SIZES)],
    ]
    return table(["", "3 drones, 20 Hz", "50 drones, 10 Hz"], rows)


def _cells(sheet: Sheet, name: str) -> list[str]:
    return [spread(sheet.spread(name, count)) for count in SIZES]
