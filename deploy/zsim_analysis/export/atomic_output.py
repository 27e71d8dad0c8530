"""Puts an export in its place when all of it is written: Ctrl-C and full disks leave nothing that looks finished."""

import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec
from msgspec import Struct

from zsim.contract.messages import REFUSALS
from zsim.errors import ReportError
from zsim.record.run_folder import RECORD

MANIFEST = "export.json"  # tells a folder of tables from any other folder
MATLAB = b"MATLAB 5.0 MAT-file Platform: "  # as SciPy begins a file; MATLAB itself has a comma in it
MCAP, MCAP_LIBRARY = b"\x89MCAP", b"foxglove-sdk"  # a file for Foxglove names its library; a record names zsim
HEAD_MAX = 200  # bytes within which an MCAP file has named its library
LAYOUT = "-layout.json"  # ends the name of the file beside one for Foxglove
OF_A_RUN = (RECORD, "scenario.yaml", "summary.json", "report.html")  # what no export may replace


def check_free(target: Path, force: bool, record: Path) -> None:
    """Refuse to write where something is that must stay.

    Raises:
        ReportError: something is there and `force` is not given; or it is the record, or no export.
    """
    if not target.exists():
        return
    if target.resolve() == record.resolve():
        raise ReportError(f"{target}: is the record itself; give --out another place")
    if not force:
        raise ReportError(f"{target}: exists; give --out another place, or --force to replace it")
    if target.is_dir() and (other := _other(target)):
        raise ReportError(f"{target}: is a folder of something else than an export ({other}); give --out another place")
    if target.is_file() and not _is_export(target):
        raise ReportError(f"{target}: is a file of something else than an export; give --out another place")


class _Manifest(Struct):
    tables: dict[str, object]


def _other(folder: Path) -> str:
    """Return what shows that a folder is not, or not only, an export; "" if it is one."""
    try:
        manifest = msgspec.json.decode((folder / MANIFEST).read_bytes(), type=_Manifest)
    except (OSError, *REFUSALS):
        return f"it has no {MANIFEST} of one"
    others = {path.name for path in folder.iterdir()} - {MANIFEST, *manifest.tables}
    return f"it holds {min(others)}" if others else ""


def _is_export(file: Path) -> bool:
    with file.open("rb") as opened:
        head = opened.read(HEAD_MAX)
    if file.name.endswith(LAYOUT):
        return head.startswith(b"{")
    return file.name not in OF_A_RUN and (head.startswith(MATLAB) or (head.startswith(MCAP) and MCAP_LIBRARY in head))


def _reason(error: OSError) -> str:
    """Return why, without what libraries that write files say around it."""
    return os.strerror(error.errno) if error.errno else str(error)


@contextmanager
def placed(*targets: Path) -> Iterator[tuple[Path, ...]]:
    """Yield a path for each file or folder that is to be written; put them in place together at the end.

    What is in their places by then is replaced: `check_free` is asked first.

    Raises:
        ReportError: they cannot be written.
    """
    try:
        with _beside(targets[0]) as folder:  # on the same disk, so that it can be put in place
            written = tuple(folder / target.name for target in targets)
            yield written
            _put_in_place(written, targets)
    except OSError as error:
        raise ReportError(f"{targets[0]}: cannot be written ({_reason(error)}); make room and export again") from error


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """Yield a new folder; at the end it is removed, and the parents that were made for it if nothing is in them."""
    made = [parent for parent in target.parents if not parent.exists()]
    folder = target.parent / f".export-{secrets.token_hex(4)}"
    try:
        folder.mkdir(parents=True)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # one that holds something stays, and with it those above
            for parent in made:
                parent.rmdir()


def _put_in_place(written: Sequence[Path], targets: Sequence[Path]) -> None:
    """Put all files or folders in place; when that fails, or Ctrl-C comes, all is as it was before."""
    olds = [new.with_name(f"{new.name}.old") for new in written]
    try:
        for new, target, old in zip(written, targets, olds, strict=True):
            if target.exists():
                target.replace(old)
            new.replace(target)
    except BaseException:
        for new, target, old in zip(written, targets, olds, strict=True):
            if not new.exists() and target.exists():
                target.replace(new)
            if old.exists():
                old.replace(target)
        raise
