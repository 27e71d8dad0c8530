"""A run that was interrupted: how it was launched, kept beside the journal of its world, and where it goes on."""

import json
from contextlib import suppress
from pathlib import Path

import msgspec

from zsim.contract import keys, messages
from zsim.errors import DecodeError, RunError
from zsim.output_folder import RECORD
from zsim.record.record_writer import cut_at_last

JOURNAL = "journal"  # in the folder of a run; what the world hands itself is there too
LAUNCH = "launch.json"


class Launch(msgspec.Struct, frozen=True):
    """How a run was launched; `modules`: folders in which those that its scenario names were looked for."""

    run_id: str
    mode: str = "lockstep"
    rate: float = 0.0
    in_process: bool = False
    hosted: bool = False
    insecure: bool = False
    listen: str | None = None
    modules: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()


def keep(folder: Path, launch: Launch) -> None:
    """Note how a run is launched.

    Raises:
        OSError: it cannot be written.
    """
    (folder / JOURNAL).mkdir(exist_ok=True)
    content = json.dumps(msgspec.to_builtins(launch))  # not msgspec's: a path may hold bytes that are no UTF-8
    (folder / JOURNAL / LAUNCH).write_text(content, "utf-8")


def forget(folder: Path) -> None:
    """Remove the note: nothing flew, or all of it."""
    with suppress(OSError):
        (folder / JOURNAL / LAUNCH).unlink(missing_ok=True)
        (folder / JOURNAL).rmdir()


def launch_of(folder: Path) -> Launch:
    """Return how a run was launched that is to go on.

    Raises:
        RunError: nothing is left of it to do, or it is no run.
    """
    place = folder / JOURNAL / LAUNCH
    try:
        return msgspec.convert(json.loads(place.read_bytes()), Launch)
    except FileNotFoundError as error:
        state = "is over" if (folder / RECORD).exists() else "is not there"
        raise RunError(f"{folder}: the run {state}; must be the folder of one that was interrupted") from error
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        raise RunError(f"{place}: cannot be read ({error}); must be as zsim run has left it") from error


def reopen_record(folder: Path) -> None:
    """Take the end of the interrupted run off its record.

    Raises:
        RecordError: it cannot be written, or another process writes it.
    """
    record = folder / RECORD
    if record.exists():
        cut_at_last(record, keys.EVENT, _is_end)


def _is_end(payload: bytes) -> bool:
    try:
        return messages.decode(keys.EVENT, payload).kind == "end"
    except DecodeError:
        return False
