"""The folder of a record, which may be named after its run."""

import re
from pathlib import Path

from zsim.errors import RecordError
from zsim_deploy.arguments import RUN_ID

RECORD = "run.mcap"
RUN_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")  # an id of a run that is part of a folder's name


def record_folder(out: Path, run_id: str) -> Path:
    """Return the folder of a run's record.

    Raises:
        RecordError: the id, which the world gives, would lead to another folder.
    """
    if RUN_ID not in out.name:
        return out
    if not RUN_NAME.fullmatch(run_id):
        allowed = f"must be 1 to 64 of A-Z a-z 0-9 _ -; give --out without {RUN_ID}"
        raise RecordError(f"{out}: run is {run_id[:40]!r}; {allowed}")
    return out.with_name(out.name.replace(RUN_ID, run_id))


def make(folder: Path) -> None:
    """Make the folder of a record.

    Raises:
        RecordError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{folder}: cannot be made ({error.strerror}); give --out another folder") from error
