"""Prepares and locks the folder of a run, which must be new or without files of another run or of other programs.

Beside the world's journal, a file records how the run was launched, so that an interrupted run can be continued.
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
JOURNAL = "journal"  # folder of the world's journal
LAUNCH = "launch.json"  # file in the journal's folder
LEFTOVERS = (SCENARIO, "run.log", "up.log")  # files left by a run that never flew, beside empty logs and journal
WRITTEN = (RECORD, "summary.json", "report.html", *LEFTOVERS)  # files removed when a run is replaced
WRITTEN_INTO = {LOGS: (".log",), FIGURES: (".png", ".pdf", ".svg")}  # suffixes of a run's files, by folder


@contextmanager
def run_directory(out: Path | None, scenario: Scenario, force: bool = False) -> Iterator[Path]:
    """Yield the run's folder, locked against other runs: `out`, or a new one named after scenario and time.

    With `force`, an earlier run of zsim is removed from it, and other files stay as they are.

    Raises:
        RunError: a run is in progress in the folder; it contains a run or other files; it cannot be created; or, with
            `force`, its record is not zsim's.
    """
    if out is None:
        out = _new_directory(f"{scenario.name}-{time.strftime('%Y%m%d-%H%M%S')}")
    with file_fault(out, "cannot be created", OTHER_OUT):
        if not out.exists():
            out.mkdir(parents=True, exist_ok=True)
            _MADE.add(out.resolve())
    with locked(out):
        _make_room(out, force)
        yield out


def make_directory(out: Path | None, scenario: Scenario, force: bool = False) -> Path:
    """Return the folder of `run_directory`, unlocked, for a run by another process, which locks it itself."""
    with run_directory(out, scenario, force) as folder:
        return folder


@contextmanager
def locked(folder: Path) -> Iterator[Path]:
    """Yield a run's folder, locked until the block is left, so that no other run, even of this process, uses it.

    A run has no file that exists from the beginning, so the folder itself is locked. NFS and Windows cannot lock
    folders; there, the locks of record and journal must suffice.
    """
    with file_fault(folder, "cannot be opened", OTHER_OUT):
        opened = None if os.name == "nt" else os.open(folder, os.O_RDONLY)
    try:
        if opened is not None and not take_lock(opened):
            raise RunError(f"{folder}: a run is in progress in it; end that run, or give --out another folder")
        yield folder
    finally:
        if opened is not None:
            os.close(opened)


def _new_directory(name: str) -> Path:
    """Create a folder in `runs` that no other run uses, since several may start within one second."""
    folder = first = Path("runs") / name
    with file_fault(first, "cannot be created", OTHER_OUT):
        for number in count(2):
            try:
                folder.mkdir(parents=True)
                break
            except FileExistsError:
                folder = first.with_name(f"{name}-{number}")
    _MADE.add(folder.resolve())
    return folder


def _make_room(out: Path, force: bool) -> None:
    """Raise RunError for a folder with a run or other files; with `force`, remove the run."""
    with file_fault(out, "cannot be created", OTHER_OUT):
        if force:
            _remove_run(out)
        elif any((out / JOURNAL).glob("*.entries")):
            options = f"`zsim run --continue {out}` continues it, --force replaces it, or give --out another folder"
            raise RunError(f"{out}: contains an interrupted run; {options}")
        elif (out / RECORD).exists() or any(not log.is_file() or log.stat().st_size for log in (out / LOGS).glob("*")):
            raise RunError(f"{out}: already contains a run; --force replaces it, or give --out another folder")
        refuse_others(out, (*LEFTOVERS, LOGS, JOURNAL), force, "fly into")


_MADE: set[Path] = set()  # folders that this process has created


def _remove_run(folder: Path) -> None:
    """Remove the files of a zsim run and of its report; all other files, including exports, stay."""
    record, journal = folder / RECORD, folder / JOURNAL
    if record.exists():
        with record.open("rb") as file:
            opening = file.read(LIBRARY + len(OURS))
        if opening and not is_ours(opening):  # an empty record was left by a run killed at its start
            raise RunError(f"{record}: is not a record of zsim and is not removed; give --out another folder")
    journaled = (journal / LAUNCH).exists() or any(journal.glob("*.entries"))
    failed = (folder / SCENARIO).exists() and (folder / LOGS / "world.log").exists()
    if not (record.exists() or journaled or failed):
        return  # `logs`, `figures` and `journal` do not belong to a run
    if is_being_written(record):
        raise RunError(f"{folder}: a run is in progress in it; end that run, or give --out another folder")
    for name, suffixes in WRITTEN_INTO.items():
        for path in (folder / name).glob("*"):
            if path.suffix in suffixes and path.is_file():
                path.unlink()
        with suppress(OSError):  # it does not exist, or contains other files
            (folder / name).rmdir()
    if journaled:
        shutil.rmtree(journal)
    for path in (*(folder / name for name in WRITTEN), *_modules(folder)):
        path.unlink(missing_ok=True)


def _modules(folder: Path) -> Iterator[Path]:
    """Yield the modules generated for a run's classes that were defined in a notebook or script."""
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
    modules: tuple[str, ...] = ()  # folders searched for modules that the scenario names
    agents: tuple[tuple[str, ...], ...] = ()  # the user's agents, as returned by `AgentSpec.arguments`
    changed: tuple[str, ...] = ()  # overrides `a.b.c=value` applied to the scenario's file


def new_launch(**how: Any) -> Launch:
    """Return the launch of a new run, with the folders in which its scenario's modules were found."""
    return Launch(uuid.uuid4().hex[:12], modules=tuple(map(str, plugin.folders())), **how)


def prepare(
    folder: Path, scenario: Scenario, launch: Launch, say: Callable[[str], None], continued: bool = False
) -> None:
    """Write scenario and launch into the run's folder, unless the run is `continued`, and announce the run.

    Raises:
        RunError: the folder cannot be written.
    """
    if not continued:
        with file_fault(folder, "cannot be written", OTHER_OUT):
            if not launch.in_process:
                (folder / LOGS).mkdir(exist_ok=True)
            (folder / SCENARIO).write_text(scenario_file.to_text(scenario))
            (folder / JOURNAL).mkdir(exist_ok=True)
            content = json.dumps(msgspec.to_builtins(launch))  # unlike msgspec, json allows paths not in UTF-8
            (folder / JOURNAL / LAUNCH).write_text(content, "utf-8")
    say(f"{scenario.name}: {len(scenario.drones)} drones, {scenario.duration_s:g} s, into {folder}")
    for line in (*unflown_plans(scenario), no_locks(folder)):
        if line:
            say(line)


def forget_launch(folder: Path) -> None:
    """Remove the launch file of a run that either did not fly at all or flew to its end."""
    with suppress(OSError):
        (folder / JOURNAL / LAUNCH).unlink(missing_ok=True)
        (folder / JOURNAL).rmdir()


@contextmanager
def left_only_if_flown(folder: Path) -> Iterator[None]:
    """If a flight fails before anything is recorded, remove what was prepared, and the folder if it was created."""
    try:
        yield
    except BaseException:
        if not (folder / RECORD).exists():
            forget_launch(folder)
            for path in (folder / SCENARIO, *_modules(folder)):
                with suppress(OSError):
                    path.unlink()
            with suppress(OSError):  # it contains other files
                if folder.resolve() in _MADE:
                    folder.rmdir()
        raise


def launch_of(folder: Path) -> Launch:
    """Return the launch of an interrupted run; raise RunError if the folder contains no readable one."""
    path = folder / JOURNAL / LAUNCH
    try:
        return msgspec.convert(json.loads(path.read_bytes()), Launch)
    except FileNotFoundError as error:
        state = "is over" if (folder / RECORD).exists() else "does not exist"
        raise RunError(f"{folder}: the run {state}; must be the folder of one that was interrupted") from error
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        raise RunError(f"{path}: cannot be read ({error}); must be as `zsim run` wrote it") from error


def reopen_record(folder: Path) -> None:
    """Truncate an interrupted run's record at its `end` event; raise RecordError if another process is writing it."""

    def is_end(payload: bytes) -> bool:
        try:
            return messages.decode(keys.EVENT, payload).kind == "end"
        except DecodeError:
            return False

    record = folder / RECORD
    if record.exists():
        cut_at_last(record, keys.EVENT, is_end)
