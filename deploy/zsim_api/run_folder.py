"""The folder of a run: made new, or one that holds nothing which a run would hide or be mixed up with.

How the run was launched is kept in it, beside the journal of its world, so that an interrupted run can go on.
"""

import json
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.errors import OTHER_OUT, DecodeError, RunError, file_fault
from zsim.output_folder import RECORD, no_locks, refuse_others, take_lock
from zsim.record.mcap_layout import LIBRARY, OURS, is_ours
from zsim.record.record_writer import cut_at_last, is_being_written
from zsim.scenario import scenario_file
from zsim.scenario.consistency import unflown_plans
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin

LOGS, SCENARIO, FIGURES = "logs", "scenario.yaml", "figures"
JOURNAL = "journal"  # what the world hands itself is there
LAUNCH = "launch.json"  # in it
LEFT = (SCENARIO, "run.log", "up.log")  # beside empty logs and an empty journal: all that a run leaves that never flew
WRITTEN = (RECORD, "summary.json", "report.html", *LEFT)  # of a run that is replaced
WRITTEN_INTO = {LOGS: (".log",), FIGURES: (".png", ".pdf", ".svg")}  # suffixes of a run's files, by folder


@contextmanager
def run_directory(out: Path | None, scenario: Scenario, force: bool = False) -> Iterator[Path]:
    """Yield the run's folder, locked against other runs: `out`, or a new one named after scenario and time.

    With `force`, one that holds other files, too, which stay as they are; an earlier run of zsim's is removed.
    RunError if a run is under way in it, if it holds a run, or other files, or cannot be made; with `force`, if its
    record is not zsim's.
    """
    if out is None:
        out = _new_directory(f"{scenario.name}-{time.strftime('%Y%m%d-%H%M%S')}")
    with file_fault(out, "cannot be made", OTHER_OUT):
        if not out.exists():
            out.mkdir(parents=True, exist_ok=True)
            _MADE.add(out.resolve())
    with locked(out):
        _make_room(out, force)
        yield out


def make_directory(out: Path | None, scenario: Scenario, force: bool = False) -> Path:
    """Return the folder of `run_directory` for a run that another process flies, which locks it."""
    with run_directory(out, scenario, force) as folder:
        return folder


@contextmanager
def locked(folder: Path) -> Iterator[Path]:
    """Yield a run's folder, locked until the block is left, so that no other run is flown into it, of this process too.

    A run has no file from its first moment on, so the folder itself is locked. NFS locks no folders: there the locks of
    record and journal must do.
    """
    with file_fault(folder, "cannot be opened", OTHER_OUT):
        opened = None if os.name == "nt" else os.open(folder, os.O_RDONLY)
    try:
        if opened is not None and not take_lock(opened):
            raise RunError(f"{folder}: a run is flown into it now; end that one, or give --out another folder")
        yield folder
    finally:
        if opened is not None:
            os.close(opened)


def _new_directory(name: str) -> Path:
    """Make a folder in `runs` that no other run has made: several may start within one second."""
    folder = first = Path("runs") / name
    with file_fault(first, "cannot be made", OTHER_OUT):
        for number in count(2):
            try:
                folder.mkdir(parents=True)
                break
            except FileExistsError:
                folder = first.with_name(f"{name}-{number}")
    _MADE.add(folder.resolve())
    return folder


def _make_room(out: Path, force: bool) -> None:
    """Refuse a folder that holds a run, or other files; with `force`, remove the run."""
    with file_fault(out, "cannot be made", OTHER_OUT):
        if force:
            _remove_run(out)
        elif any((out / JOURNAL).glob("*.entries")):
            way = f"`zsim run --continue {out}` goes on with it, --force replaces it, or give --out another folder"
            raise RunError(f"{out}: holds a run that was interrupted; {way}")
        elif (out / RECORD).exists() or any(not log.is_file() or log.stat().st_size for log in (out / LOGS).glob("*")):
            raise RunError(f"{out}: holds a run already; --force replaces it, or give --out another folder")
        refuse_others(out, (*LEFT, LOGS, JOURNAL), force, "fly into")


_MADE: set[Path] = set()  # folders that were not there before


def _remove_run(folder: Path) -> None:
    """Remove what a run of zsim's has written, and its report; whatever else is there stays, exports too."""
    record, journal = folder / RECORD, folder / JOURNAL
    if record.exists():
        with record.open("rb") as file:
            opening = file.read(LIBRARY + len(OURS))
        if opening and not is_ours(opening):  # an empty one was killed before it had begun
            raise RunError(f"{record}: is no record of zsim's and is not removed; give --out another folder")
    journaled = (journal / LAUNCH).exists() or any(journal.glob("*.entries"))
    failed = (folder / SCENARIO).exists() and (folder / LOGS / "world.log").exists()
    if not (record.exists() or journaled or failed):
        return  # `logs`, `figures` and `journal` are not of a run
    if is_being_written(record):
        raise RunError(f"{folder}: a run is flown into it now; end that one, or give --out another folder")
    for name, suffixes in WRITTEN_INTO.items():
        for path in (folder / name).glob("*"):
            if path.suffix in suffixes and path.is_file():
                path.unlink()
        with suppress(OSError):  # not there, or it holds other files
            (folder / name).rmdir()
    if journaled:
        shutil.rmtree(journal)
    for path in (*(folder / name for name in WRITTEN), *_modules(folder)):
        path.unlink(missing_ok=True)


def _modules(folder: Path) -> Iterator[Path]:
    """Yield the modules that were made for a run's classes of a notebook or a script."""
    return folder.glob(f"{plugin.MADE}*.py")


class Launch(msgspec.Struct, frozen=True):
    """How a run was launched."""

    run_id: str
    mode: str = "lockstep"
    rate: float = 0.0
    in_process: bool = False
    hosted: bool = False
    insecure: bool = False
    listen: str | None = None
    modules: tuple[str, ...] = ()  # folders in which those that its scenario names were looked for
    agents: tuple[tuple[str, ...], ...] = ()  # of the user's own, as words of `AgentSpec`
    changed: tuple[str, ...] = ()  # texts `a.b.c=value` by which the scenario was changed against its file


def new_launch(**how: Any) -> Launch:
    """Return a launch of a new run, with the modules that its scenario has been loaded with."""
    return Launch(uuid.uuid4().hex[:12], modules=tuple(map(str, plugin.folders())), **how)


def prepare(
    folder: Path, scenario: Scenario, launch: Launch, say: Callable[[str], None], continued: bool = False
) -> None:
    """Put what is to be flown, and how, into the run's folder, if that is not `continued`; and say it.

    RunError if it cannot be written.
    """
    if not continued:
        with file_fault(folder, "cannot be written", OTHER_OUT):
            if not launch.in_process:
                (folder / LOGS).mkdir(exist_ok=True)
            (folder / SCENARIO).write_text(scenario_file.to_text(scenario))
            (folder / JOURNAL).mkdir(exist_ok=True)
            content = json.dumps(msgspec.to_builtins(launch))  # not msgspec's: a path may hold no UTF-8
            (folder / JOURNAL / LAUNCH).write_text(content, "utf-8")
    say(f"{scenario.name}: {len(scenario.drones)} drones, {scenario.duration_s:g} s, into {folder}")
    for line in (*unflown_plans(scenario), no_locks(folder)):
        if line:
            say(line)


def forget_launch(folder: Path) -> None:
    """Remove the note: nothing flew, or all of it."""
    with suppress(OSError):
        (folder / JOURNAL / LAUNCH).unlink(missing_ok=True)
        (folder / JOURNAL).rmdir()


@contextmanager
def left_only_if_flown(folder: Path) -> Iterator[None]:
    """Remove what is prepared for a flight that fails before anything is recorded, and the folder if it was made."""
    try:
        yield
    except BaseException:
        if not (folder / RECORD).exists():
            forget_launch(folder)
            for path in (folder / SCENARIO, *_modules(folder)):
                with suppress(OSError):
                    path.unlink()
            with suppress(OSError):  # it holds something else
                if folder.resolve() in _MADE:
                    folder.rmdir()
        raise


def launch_of(folder: Path) -> Launch:
    """Return how a run was launched that is to go on; RunError if nothing is left of it to do, or it is no run."""
    place = folder / JOURNAL / LAUNCH
    try:
        return msgspec.convert(json.loads(place.read_bytes()), Launch)
    except FileNotFoundError as error:
        state = "is over" if (folder / RECORD).exists() else "is not there"
        raise RunError(f"{folder}: the run {state}; must be the folder of one that was interrupted") from error
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        raise RunError(f"{place}: cannot be read ({error}); must be as zsim run has left it") from error


def reopen_record(folder: Path) -> None:
    """Take the end of the interrupted run off its record; RecordError if another process writes it."""

    def is_end(payload: bytes) -> bool:
        try:
            return messages.decode(keys.EVENT, payload).kind == "end"
        except DecodeError:
            return False

    record = folder / RECORD
    if record.exists():
        cut_at_last(record, keys.EVENT, is_end)
