"""The folder of a run: made new, or one that holds nothing which a run would hide or be mixed up with."""

import time
from pathlib import Path

from zsim.errors import RunError
from zsim.output_folder import refuse_others
from zsim.scenario.scenario import Scenario
from zsim_deploy.launch.interrupted_run import JOURNAL

RECORD, LOGS, SCENARIO = "run.mcap", "logs", "scenario.yaml"
LEFT = (SCENARIO, "run.log", "up.log")  # beside empty logs and an empty journal: all that a run leaves that never flew


def make_directory(out: Path | None, scenario: Scenario, force: bool = False) -> Path:
    """Return the run's folder.

    Args:
        out: as given; None for a new one named after scenario and time.
        scenario: that is flown.
        force: take one that holds other files, too. They stay as they are; a record is never overwritten.

    Raises:
        RunError: it holds a run, or other files, or cannot be made.
    """
    folder = out or _fresh(Path("runs") / f"{scenario.name}-{time.strftime('%Y%m%d-%H%M%S')}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
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
        way = f"`zsim run --continue {folder}` goes on with it, or give --out another folder"
        raise RunError(f"{folder}: holds a run that was interrupted; {way}")
    if (folder / RECORD).exists() or written:
        raise RunError(f"{folder}: holds a run already; give --out another folder")


def _fresh(folder: Path) -> Path:
    """Return a folder that is not there yet: two runs may start within one second."""
    names = [folder, *(folder.with_name(f"{folder.name}-{i}") for i in range(2, 1000))]
    return next(name for name in names if not name.exists())
