"""The folder of a run: made new, or one that holds nothing which a run would hide or be mixed up with."""

import shutil
import time
from contextlib import suppress
from pathlib import Path

from zsim.errors import RunError
from zsim.output_folder import refuse_others
from zsim.record.mcap_layout import LIBRARY, OURS, is_ours
from zsim.record.record_writer import is_being_written
from zsim.scenario.scenario import Scenario
from zsim_deploy.launch.interrupted_run import JOURNAL, LAUNCH

RECORD, LOGS, SCENARIO, FIGURES = "run.mcap", "logs", "scenario.yaml", "figures"
LEFT = (SCENARIO, "run.log", "up.log")  # beside empty logs and an empty journal: all that a run leaves that never flew
WRITTEN = (RECORD, "summary.json", "report.html", *LEFT)  # of a run that is replaced
WRITTEN_INTO = {LOGS: (".log",), FIGURES: (".png", ".pdf", ".svg")}  # suffixes of a run's files, by folder


def make_directory(out: Path | None, scenario: Scenario, force: bool = False) -> Path:
    """Return the run's folder.

    Args:
        out: as given; None for a new one named after scenario and time.
        scenario: that is flown.
        force: take one that holds other files, too, which stay as they are; an earlier run of zsim's is removed.

    Raises:
        RunError: it holds a run, or other files, or cannot be made; with `force`, the run is under way, or its record
            is not zsim's.
    """
    folder = out or _fresh(Path("runs") / f"{scenario.name}-{time.strftime('%Y%m%d-%H%M%S')}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if force:
            _remove_run(folder)
        else:
            _refuse_run(folder)
        refuse_others(folder, (*LEFT, LOGS, JOURNAL), force, "fly into")
    except OSError as error:
        raise RunError(f"{folder}: cannot be made ({error.strerror}); give --out another folder") from error
    return folder


def _refuse_run(folder: Path) -> None:
    """Refuse a folder with a record, or with logs in which something was written."""
    logs = folder / LOGS
    written = [log.name for log in logs.iterdir() if not log.is_file() or log.stat().st_size] if logs.exists() else []
    if any((folder / JOURNAL).glob("*.entries")):
        way = f"`zsim run --continue {folder}` goes on with it, --force replaces it, or give --out another folder"
        raise RunError(f"{folder}: holds a run that was interrupted; {way}")
    if (folder / RECORD).exists() or written:
        raise RunError(f"{folder}: holds a run already; --force replaces it, or give --out another folder")


def _remove_run(folder: Path) -> None:
    """Remove what a run of zsim's has written, and its report; whatever else is there stays, exports too.

    Raises:
        RunError: the record is not zsim's, or the run is under way.
        OSError: it cannot be removed.
    """
    record, journal = folder / RECORD, folder / JOURNAL
    if record.exists():
        with record.open("rb") as file:
            opening = file.read(LIBRARY + len(OURS))
        if opening and not is_ours(opening):  # an empty one was killed before it had begun
            raise RunError(f"{record}: is no record of zsim's and is not removed; give --out another folder")
    journaled = (journal / LAUNCH).exists() or any(journal.glob("*.entries"))
    failed = (folder / SCENARIO).exists() and (folder / LOGS / "world.log").exists()
    if not (record.exists() or journaled or failed):
        return  # `logs`, `figures` and `journal` are somebody else's
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
    for name in WRITTEN:
        (folder / name).unlink(missing_ok=True)


def _fresh(folder: Path) -> Path:
    """Return a folder that is not there yet: two runs may start within one second."""
    names = [folder, *(folder.with_name(f"{folder.name}-{i}") for i in range(2, 1000))]
    return next(name for name in names if not name.exists())
