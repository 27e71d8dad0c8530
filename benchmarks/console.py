"""Part h: what the console costs: its share of a core, and what a run in lockstep loses by it.

The share is processor time by wall time of the console's process, with one page open: a client that reads all that a
page is sent, or a real browser. The run's loss is its real-time factor with the console, and such a client, by that
without, one after the other.
"""

import json
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import msgspec
import psutil
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from benchmarks import grid
from benchmarks.child import RefusedError
from benchmarks.exchange.lap import free_port
from benchmarks.progress import Progress
from benchmarks.sheet import Sheet
from benchmarks.table import figure, spread, table
from zsim.record import RecordReader
from zsim_agents.console.guard import Camera

CLI = (sys.executable, "-m", "zsim_deploy.cli")
SIZES = (3, 50)  # drones
SECONDS = 15.0  # wall time over which a share is taken
SETTLE_S = 5.0  # wall time before it: a page that is opened is sent everything at once
FLIGHT_S = {3: 120.0, 50: 12.0}  # simulated, of a run whose real-time factor is taken
TIMEOUT_S = 300.0
LOOK_S = 0.2
GOALS = {3: 15.0, 50: 60.0}  # percent of a core
LEAST_RATIO = 0.9
PICTURES_HZ = {3: 20.0, 50: 10.0}  # of the console, by its number of drones
LEAST_PICTURES = 0.8  # share of them; below it the console was starved, and looks cheap
LEAST_RATE = 0.9  # of real time; below it the run was starved, and gave the console less to draw
DRONES = "/drones"  # the node of the scene
CHROMIUM = "/usr/bin/chromium"
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
CAMERA = Camera(  # what a page says first; before it, viser heeds no control of it
    (1.0, 0.0, 0.0, 0.0), (0.0, -5.0, 3.0), 1.0, 0.01, 1000.0, 600, 800, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
)


class Reader:
    """A page without a picture: reads all that viser sends.

    Args:
        port: of the console.

    Attributes:
        received: bytes.
        pictures: how often the drones have been drawn anew.
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
        """Hang up."""
        self._socket.close()
        self._thread.join()


def _has_drones(said: str | bytes) -> bool:
    """Tell whether what viser sends puts the drones elsewhere: lengths, then what is packed, then arrays."""
    assert isinstance(said, bytes)
    packed = said[16 : 16 + int.from_bytes(said[8:16], "little")]
    told = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed), strict=False)["messages"]
    return any(each.get("name") == DRONES and "batched_positions" in each.get("updates", ()) for each in told)


@contextmanager
def _started(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Start a `zsim` command, and end it."""
    quiet = subprocess.DEVNULL
    process = subprocess.Popen([*CLI, *arguments], stdin=quiet, stdout=quiet, stderr=quiet)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(TIMEOUT_S)


def _await(condition: Callable[[], bool], what: str) -> None:
    until_s = time.monotonic() + TIMEOUT_S
    while not condition():
        if time.monotonic() > until_s:
            raise RefusedError(f"{what} did not come within {TIMEOUT_S:g} s")
        time.sleep(LOOK_S)


def _runs(port: int) -> bool:
    """Tell whether a console shows drones that move on."""
    with suppress(OSError, KeyError):  # the page is there before it shows a run
        return _shown_s(port) > 3.0
    return False


@contextmanager
def _flying(folder: Path, count: int) -> Iterator[tuple[int, psutil.Process]]:
    """Fly so many drones at 1 x real time; yield the console's port and process."""
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


def _share(console: psutil.Process, read: Callable[[], int]) -> tuple[float, float]:
    """Return the share of a core [%], and what a page was sent meanwhile [kB/s]."""
    time.sleep(SETTLE_S)
    before, sent, start_s = console.cpu_times(), read(), time.monotonic()
    time.sleep(SECONDS)
    after, wall_s = console.cpu_times(), time.monotonic() - start_s
    spent_s = after.user + after.system - before.user - before.system
    return 100.0 * spent_s / wall_s, (read() - sent) / wall_s / 1000.0


@contextmanager
def _kept_up(port: int, reader: Reader, count: int) -> Iterator[None]:
    """Refuse what was measured if too few pictures were drawn meanwhile, or the run did not keep up with real time."""
    pictures, simulated_s, wall_s = reader.pictures, _shown_s(port), time.monotonic()
    yield
    wall_s = time.monotonic() - wall_s
    drawn_hz, factor = (reader.pictures - pictures) / wall_s, (_shown_s(port) - simulated_s) / wall_s
    if drawn_hz < LEAST_PICTURES * PICTURES_HZ[count] or factor < LEAST_RATE:
        goal = f"{PICTURES_HZ[count]:g} pictures a second at × 1"
        raise RefusedError(f"{count} drones: {drawn_hz:.1f} pictures a second at × {factor:.2f}; must be about {goal}")


def _shown_s(port: int) -> float:
    """Return the simulated time that a console shows."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/state", timeout=5.0) as answer:
        return float(json.load(answer)["t_s"])


def _measure_shares(sheet: Sheet, folder: Path, count: int) -> str:
    with _flying(folder, count) as (port, console):
        alone, _ = _share(console, lambda: 0)
        reader = Reader(port)
        try:
            with _kept_up(port, reader, count):
                read, rate = _share(console, lambda: reader.received)
        finally:
            reader.close()
        browser = _browser_share(console, port)
    for name, value in {"alone": alone, "read": read, "rate": rate, "browser": browser}.items():
        sheet.add(name, count, value)
    return f"{count} drones: {read:.1f} % of a core"


def _browser_share(console: psutil.Process, port: int) -> float | None:
    """Return the share with a page in a real browser [%], None where there is none."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    if not Path(CHROMIUM).exists():
        return None
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        try:
            page = browser.new_page(viewport={"width": 800, "height": 500})
            page.goto(f"http://127.0.0.1:{port}/", timeout=1000 * TIMEOUT_S)
            page.get_by_text("running").first.wait_for(timeout=1000 * TIMEOUT_S)
            return _share(console, lambda: 0)[0]
        finally:
            browser.close()


def _factor(folder: Path, count: int, shown: bool) -> float:
    """Return the real-time factor of a run as fast as it goes, with a console that is looked at, or without."""
    scenario, world, port = folder / f"fast{count}.yaml", free_port(), free_port()
    out, endpoint = folder / f"out{world}", f"tcp/127.0.0.1:{world}"
    grid.write(scenario, count, FLIGHT_S[count])
    run = ("run", str(scenario), "--listen", endpoint, "--hosted", "--no-report", "--out", str(out))
    with ExitStack() as stack:
        if shown:
            stack.enter_context(_started("console", "--connect", endpoint, "--port", str(port)))
            _await(lambda: _answers(port), "the console's page")
            stack.callback(Reader(port).close)
        process = stack.enter_context(_started(*run))
        process.wait(TIMEOUT_S)
    with RecordReader(out / "run.mcap") as reader:
        said = [msgspec.msgpack.decode(message.payload) for message in reader.messages(("world/event",))]
    return next(event["data"]["real_time_factor"] for event in said if event["kind"] == "end")


def _answers(port: int) -> bool:
    with suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/state", timeout=5.0):
        return True
    return False


def measure(repeats: int) -> Sheet:
    """Measure everything in turn, so often."""
    sheet = Sheet("h", "% of a core, and × real time")
    progress = Progress("h", 2 * repeats * len(SIZES))
    with tempfile.TemporaryDirectory() as temporary:
        for _ in range(repeats):
            for count in SIZES:
                progress.tell(_measure_shares(sheet, Path(temporary), count))
                for name in ("without", "with"):
                    sheet.add(name, count, _factor(Path(temporary), count, name == "with"))
                found = [sheet.values[name][count][-1] for name in ("without", "with")]
                progress.tell(f"{count} drones: × {found[0]:.1f} without, × {found[1]:.1f} with")
    return sheet


def page(sheet: Sheet) -> str:
    """Return the measured section."""
    rows = [
        ["nobody looks [% of a core]", *_cells(sheet, "alone")],
        ["one page, read whole [% of a core]", *_cells(sheet, "read")],
        ["one page in Chromium [% of a core]", *_cells(sheet, "browser")],
        ["goal for one page [% of a core]", *(f"≤ {figure(GOALS[count])}" for count in SIZES)],
        ["sent to a page [kB/s]", *_cells(sheet, "rate")],
        ["as fast as it goes, without [× real time]", *_cells(sheet, "without")],
        ["as fast as it goes, with one page [× real time]", *_cells(sheet, "with")],
        ["ratio", *(spread(sheet.ratio("with", "without", count)) for count in SIZES)],
    ]
    return table(["", "3 drones, 20 Hz", "50 drones, 10 Hz"], rows)


def _cells(sheet: Sheet, name: str) -> list[str]:
    return [spread(sheet.spread(name, count)) for count in SIZES]
