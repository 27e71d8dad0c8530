"""What an export can be written as, and its place: a file or folder that is there only when all of it is written.

Ctrl-C and full disks leave nothing that looks finished. The command line imports this at its start:
it needs no module of an extra.
"""

import json
import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path

from zsim.errors import ReportError, RunError


class Format(StrEnum):
    """Formats of other tools."""

    CSV = "csv"
    PARQUET = "parquet"
    MAT = "mat"
    FOXGLOVE = "foxglove"


DEFAULTS = {  # names beside the record
    Format.CSV: "csv",
    Format.PARQUET: "parquet",
    Format.MAT: "run.mat",
    Format.FOXGLOVE: "foxglove.mcap",
}
RECORD_MODULES = ("mcap", "zstandard", "numpy")  # that read a record
NEEDED = {  # modules of the extra `export`
    Format.CSV: (*RECORD_MODULES, "pyarrow"),
    Format.PARQUET: (*RECORD_MODULES, "pyarrow"),
    Format.MAT: (*RECORD_MODULES, "scipy"),
    Format.FOXGLOVE: (*RECORD_MODULES, "foxglove"),
}
MANIFEST = "export.json"  # marks a folder of tables
MATLAB = b"MATLAB 5.0 MAT-file Platform: "  # as SciPy begins a file; MATLAB itself has a comma in it
MCAP, MCAP_LIBRARY = b"\x89MCAP", b"foxglove-sdk"  # a file for Foxglove names its library; a record names zsim
HEAD_MAX = 200  # bytes within which an MCAP file has named its library
LAYOUT = "-layout.json"  # end of the name of the file beside one for Foxglove
RUN_FILES = ("run.mcap", "scenario.yaml", "summary.json", "report.html")  # what no export may replace


def check_installed(form: Format) -> None:
    """Refuse what this installation cannot write.

    Raises:
        RunError: the extra is missing.
    """
    missing = [module for module in NEEDED[form] if find_spec(module) is None]
    if missing:
        raise RunError(f"zsim export: {missing[0]} is not installed; install zsim[export]")


def check_free(target: Path, force: bool, record: Path) -> None:
    """Refuse to replace what must stay.

    Raises:
        ReportError: the target exists and `force` is not set; or it is the record, or no export.
    """
    if not target.exists():
        return
    if target.resolve() == record.resolve():
        raise ReportError(f"{target}: is the record itself; give --out another place")
    if not force:
        raise ReportError(f"{target}: exists; give --out another place, or --force to replace it")
    if target.is_dir() and (other := _foreign_content(target)):
        raise ReportError(f"{target}: is a folder of something else than an export ({other}); give --out another place")
    if target.is_file() and not _is_export(target):
        raise ReportError(f"{target}: is a file of something else than an export; give --out another place")


def _foreign_content(folder: Path) -> str:
    """Return why a folder is not, or not only, an export; "" if it is one."""
    try:
        tables = json.loads((folder / MANIFEST).read_bytes())["tables"].keys()
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return f"it has no {MANIFEST} of one"
    others = {path.name for path in folder.iterdir()} - {MANIFEST, *tables}
    return f"it holds {min(others)}" if others else ""


def _is_export(file: Path) -> bool:
    with file.open("rb") as opened:
        head = opened.read(HEAD_MAX)
    if file.name.endswith(LAYOUT):
        return head.startswith(b"{")
    return file.name not in RUN_FILES and (head.startswith(MATLAB) or (head.startswith(MCAP) and MCAP_LIBRARY in head))


def _reason(error: OSError) -> str:
    """Return the reason alone, without the text that libraries add to it."""
    return os.strerror(error.errno) if error.errno else str(error)


@contextmanager
def placed(*targets: Path) -> Iterator[tuple[Path, ...]]:
    """Yield a path for each file or folder that is to be written; put them in place together at the end.

    Existing ones are replaced: call `check_free` first.

    Raises:
        ReportError: they cannot be written.
    """
    try:
        with _beside(targets[0]) as folder:  # on the same disk, so that it can be renamed
            written = tuple(folder / target.name for target in targets)
            yield written
            _put_in_place(written, targets)
    except OSError as error:
        raise ReportError(f"{targets[0]}: cannot be written ({_reason(error)}); make room and export again") from error


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """Yield a new folder beside a target; it is removed at the end, as are parents that were made and are empty."""
    made = [parent for parent in target.parents if not parent.exists()]
    folder = target.parent / f".export-{secrets.token_hex(4)}"  # TemporaryDirectory leaves it if Ctrl-C comes within
    try:
        folder.mkdir(parents=True)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # one that is not empty stays, and with it those above
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
