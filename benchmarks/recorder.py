"""Part i: the recorder in a federation of 50 drones: whether it records everything, and what share of a core it takes.

Missing messages are found by `seq`, which counts from 0 without gaps on every key except views. The share is processor
time divided by wall time from the first recorded megabyte to the end of the run, which excludes start-up; messages and
bytes per second are those of the same time.
"""

import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import msgspec
import psutil

from benchmarks import grid, run
from benchmarks.child import RefusedError
from benchmarks.peers import ROOT
from benchmarks.run import CLI, role_of
from benchmarks.sheet import Progress, Sheet
from benchmarks.table import figure, spread, table
from zsim.contract.messages import REFUSALS
from zsim.record import RecordReader

DRONES = 50
TEST_1 = ROOT / "scenarios" / "step.yaml"
SECONDS = 20.0  # simulated duration
OPTIONS: dict[str, tuple[str, ...]] = {"lockstep": (), "realtime": ("--realtime",)}
LABELS = {"lockstep": "lockstep, as fast as it goes", "realtime": "realtime, 1×"}
BEGUN_BYTES = 1_000_000  # record size above which the run counts as under way
LOOK_S = 0.25  # wall time between two samples of the recorder's processor time
TIMEOUT_S = 300.0
FIELDS = ("core_percent", "messages_per_s", "megabytes_per_s", "missing", "broken")
SLOWEST_S = 1.0  # s; five times the period of GPS, the slowest of the keys in question


class _Seq(msgspec.Struct):
    seq: int


class Flown(NamedTuple):
    """Measurements of a recorder in one flight.

    Attributes:
        cpu_s: processor time while the run was under way.
        wall_s: wall time while the run was under way.
        sim_s: simulated time of the complete run.
        messages: number of recorded messages of the complete run.
        timed_messages, timed_bytes: recorded while the run was under way.
        faults: what is wrong with each faulty key: a message that does not decode, a break in `seq` (for views, which
            may skip, only repetitions and steps back), or an early end.
        missing: number of values of `seq` that were not recorded, views excluded.
    """

    cpu_s: float
    wall_s: float
    sim_s: float
    messages: int
    timed_messages: int
    timed_bytes: int
    faults: dict[str, str]
    missing: int


class Look(NamedTuple):
    """The time since the epoch, the recorder's processor time, and the size of the record."""

    wall_ns: int
    cpu_s: float
    size_bytes: int


def fly(drones: int, seconds: float, *options: str) -> Flown:
    """Fly a grid of drones with all sensors, their estimators and controllers in one process; measure the recorder.

    Raises:
        RefusedError: the run failed.
    """
    with tempfile.TemporaryDirectory() as temporary:
        scenario, out = Path(temporary) / "grid.yaml", Path(temporary) / "run"
        grid.write(scenario, drones, seconds)
        command = [*CLI, "run", str(scenario), "--hosted", "--no-report", "--out", str(out), *options]
        looks: list[Look] = []
        with tempfile.TemporaryFile("w+") as said:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, text=True)
            try:
                looks = list(_looks(process, out / "run.mcap"))
            finally:
                if process.poll() is None:
                    process.terminate()
                process.wait()
            said.seek(0)
            if process.returncode or len(looks) < 2:
                raise RefusedError(f"zsim run: exit code {process.returncode}: {said.read().strip()[-200:]}")
        first, last = looks[0], looks[-1]
        found = counted(out / "run.mcap", first.wall_ns, last.wall_ns)
        return Flown(
            cpu_s=last.cpu_s - first.cpu_s,
            wall_s=(last.wall_ns - first.wall_ns) / 1e9,
            sim_s=found.last_ns / 1e9,
            messages=found.messages,
            timed_messages=found.timed_messages,
            timed_bytes=last.size_bytes - first.size_bytes,
            faults=found.faults,
            missing=found.missing,
        )


def _looks(launcher: subprocess.Popen[str], record: Path) -> Iterator[Look]:
    """Look every LOOK_S while the run is under way."""
    recorder: psutil.Process | None = None
    until_s = time.monotonic() + TIMEOUT_S
    while launcher.poll() is None and time.monotonic() < until_s:
        recorder = recorder or _recorder(launcher.pid)
        if recorder is not None and record.exists() and record.stat().st_size > BEGUN_BYTES:
            with suppress(psutil.NoSuchProcess):
                spent = recorder.cpu_times()
                yield Look(time.time_ns(), spent.user + spent.system, record.stat().st_size)
        time.sleep(LOOK_S)


def _recorder(launcher: int) -> psutil.Process | None:
    try:
        children = psutil.Process(launcher).children()
        return next((child for child in children if role_of(child) == "record"), None)
    except psutil.NoSuchProcess:
        return None


class Counted(NamedTuple):
    """What is in a record; see `Flown`. `last_ns`: simulated time of the last message."""

    faults: dict[str, str]
    missing: int
    messages: int
    timed_messages: int
    last_ns: int


def counted(path: Path, from_ns: int, to_ns: int) -> Counted:
    """Count the messages of a record; timed are those recorded between these times since the epoch."""
    expected: dict[str, int] = {}
    faults: dict[str, str] = {}
    ends_ns: dict[str, int] = {}
    missing = messages = timed = last_ns = 0
    decoder = msgspec.msgpack.Decoder(_Seq)
    with RecordReader(path) as reader:
        for message in reader.messages(by_time=False):
            messages, last_ns = messages + 1, max(last_ns, message.t_ns)
            timed += from_ns < message.wall_ns <= to_ns
            try:
                seq = decoder.decode(message.payload).seq
            except REFUSALS:
                faults[message.key] = "has a message that does not decode"
                continue
            wanted = expected.get(message.key, 0)
            expected[message.key] = seq + 1
            ends_ns[message.key] = message.t_ns
            may_skip = message.key.startswith("view/")
            if seq < wanted or (seq > wanted and not may_skip):
                faults.setdefault(message.key, f"{seq} follows {wanted - 1}")
                missing += max(0, seq - wanted)
    return Counted(faults | _cut_short(ends_ns, last_ns), missing, messages, timed, last_ns)


def _cut_short(ends_ns: Mapping[str, int], last_ns: int) -> dict[str, str]:
    """Return as faults the drones' periodic keys that end over SLOWEST_S before the run, which `seq` does not show."""
    early = {key: (last_ns - end_ns) / 1e9 for key, end_ns in ends_ns.items() if key.startswith("drone/")}
    of_a_rate = {key: by_s for key, by_s in early.items() if "/sensor/" in key or key.endswith(("/truth", "/estimate"))}
    return {key: f"ends {by_s:g} s before the run" for key, by_s in of_a_rate.items() if by_s > SLOWEST_S}


def measure(repeats: int) -> Sheet:
    """Fly in both modes, in turn."""
    sheet = Sheet("i", "of a core")
    progress = Progress("i", repeats * len(LABELS))
    run.fly(TEST_1, 2.0, "--in-process")  # compiles the kernels before anything is timed
    for _ in range(repeats):
        for name in LABELS:
            progress.tell(f"{LABELS[name]}: {_measured(sheet, name)}")
    return sheet


def _measured(sheet: Sheet, name: str) -> str:
    try:
        flown = fly(DRONES, SECONDS, *OPTIONS[name])
    except RefusedError as error:
        return sheet.refuse(name, DRONES, str(error), [f"{name}_{field}" for field in FIELDS])
    wall_s = flown.wall_s
    values = (
        100.0 * flown.cpu_s / wall_s,
        flown.timed_messages / wall_s,
        flown.timed_bytes / wall_s / 1e6,
        float(flown.missing),
        float(len(flown.faults)),
    )
    for field, value in zip(FIELDS, values, strict=True):
        sheet.add(f"{name}_{field}", DRONES, value)
    counted_up = f"{flown.messages} messages, {flown.missing} missing; broken: {flown.faults or 'none'}"
    return f"{values[0]:.0f} % of a core, {counted_up}"


def page(sheet: Sheet) -> str:
    head = [f"{DRONES} drones", "share of a core, %", "messages/s", "MB/s on disk", "missing", "broken keys"]
    rows = []
    for name, label in LABELS.items():
        found = [spread(sheet.spread(f"{name}_{field}", DRONES)) for field in FIELDS[:3]]
        lost, broken = (sheet.spread(f"{name}_{field}", DRONES) for field in FIELDS[3:])
        refused = sheet.refused.get(f"{name}@{DRONES}", "–")
        rows.append([label, *found, figure(lost.high) if lost else refused, figure(broken.high) if broken else "–"])
    return table(head, rows)
