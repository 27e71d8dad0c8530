"""Puts an export in its place when all of it is written: Ctrl-C and full disks leave nothing that looks finished."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from zsim.errors import ReportError

MANIFEST = "export.json"  # tells a folder of tables from any other folder
HEADS = (b"MATLAB 5.0", b"\x89MCAP")  # of the files that exports are
LAYOUT = "-layout.json"  # ends the name of the file beside one for Foxglove
OF_A_RUN = ("run.mcap", "scenario.yaml", "summary.json", "report.html")  # what no export may replace


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
    if target.is_dir() and not (target / MANIFEST).is_file():
        raise ReportError(f"{target}: is a folder of something else than an export; give --out another place")
    if target.is_file() and not _is_export(target):
        raise ReportError(f"{target}: is a file of something else than an export; give --out another place")


def _is_export(file: Path) -> bool:
    with file.open("rb") as opened:
        head = opened.read(max(map(len, HEADS)))
    if file.name.endswith(LAYOUT):
        return head.startswith(b"{")
    return head.startswith(HEADS) and file.name not in OF_A_RUN


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
    folder = targets[0].parent / f".export-{secrets.token_hex(4)}"  # on the same disk, so that it can be put in place
    written = tuple(folder / target.name for target in targets)
    try:
        folder.mkdir(parents=True)
        yield written
        for new, target in zip(written, targets, strict=True):
            if target.is_dir():
                target.replace(folder / f"{target.name}.old")
            new.replace(target)
    except OSError as error:
        raise ReportError(f"{targets[0]}: cannot be written ({_reason(error)}); make room and export again") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
