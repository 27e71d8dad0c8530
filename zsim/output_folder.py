"""Output folders of commands, temporary folders, and the record in a run's folder.

A command writes into a folder with foreign files only if forced. Locks prevent two processes from writing into the same
folder; some file systems do not support them (Lustre, some NFS and FUSE).
"""

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile, gettempdir, mkdtemp
from typing import IO, Any

from zsim.errors import RunError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

OTHERS_NAMED = 3  # maximum number of foreign files named in an error


def take_lock(file: IO[Any] | int, shared: bool = False) -> bool:
    """Lock an open file until it is closed or the process ends; return False if another process holds the lock.

    On a file system without locks (see `no_locks`), return True.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # without locks, file systems return ENOLCK, ENOSYS or EOPNOTSUPP
        return True
    return True


def wait_for_lock(file: IO[Any]) -> None:
    """Lock an open file until it is closed, waiting if necessary; do nothing on a file system without locks."""
    if fcntl is not None:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)


def no_locks(folder: Path) -> str | None:
    """Return a warning if the file system of a folder does not support locks; else None."""
    if fcntl is None:
        return None
    try:
        with TemporaryFile(dir=folder) as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return f"{folder}: cannot be locked ({error.strerror}); do not let two commands write there at the same time"
    return None


@contextmanager
def locked_folder(folder: Path, mark: str, own: Collection[str], force: bool, use: str, others: str) -> Iterator[None]:
    """Create a folder and lock it against other processes for the duration of the block.

    Args:
        mark: file that identifies a folder of this command; `refuse_others` checks a folder without it.
        own, force, use: as for `refuse_others`.
        others: beginning of the error if the folder is locked, e.g. "another hunt is at work".

    Raises:
        RunError: the folder has foreign content, is locked, or cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / mark).exists():
            refuse_others(folder, own, force, use)
        lock_file = (folder / ".lock").open("w")
    except OSError as error:
        raise RunError(f"{folder}: cannot be created ({error.strerror}); give --out another folder") from error
    with lock_file:
        if not take_lock(lock_file):
            raise RunError(f"{folder}: {others} there; give --out another folder")
        yield


def refuse_others(folder: Path, own: Collection[str], force: bool, use: str) -> None:
    """Refuse a folder that contains files other than the command's own.

    Args:
        own: names of files that the command may overwrite.
        force: whether to accept other files, which are kept.
        use: intended use of the folder, for the error, e.g. "fly into".

    Raises:
        RunError: there are other files; the error names some.
        OSError: the folder cannot be read.
    """
    others = sorted(each.name for each in folder.iterdir() if each.name not in own)
    if others and not force:
        names = ", ".join(others[:OTHERS_NAMED]) + (", …" if len(others) > OTHERS_NAMED else "")
        raise RunError(f"{folder}: contains {names}; give --out an empty folder, or --force to {use} this one")


TEMPORARY = "zsim-temporary-"  # prefix of folders that a process keeps locked until it ends


def temporary_folder(prefix: str) -> Path:
    """Create a folder that is removed when this process ends, or, if it is killed, by the next process that calls this.

    Args:
        prefix: beginning of the folder's name.
    """
    return Path(mkdtemp(prefix=prefix, dir=_own_temporary(os.getpid())))


@cache
def _own_temporary(_pid: int) -> Path:
    """Return the parent folder of a process's temporary folders; the argument gives a forked child its own."""
    from multiprocessing.util import Finalize  # unlike atexit, also runs in children started by multiprocessing

    _remove_abandoned()
    unlocked = Path(mkdtemp(prefix="zsim-unlocked-"))
    if fcntl is not None:
        take_lock(os.open(unlocked, os.O_RDONLY))  # left open, so that the lock lasts
    folder = unlocked.rename(unlocked.with_name(unlocked.name.replace("zsim-unlocked-", TEMPORARY)))
    Finalize(None, shutil.rmtree, (folder, True), exitpriority=-100)  # after multiprocessing has joined the children
    return folder


def _remove_abandoned() -> None:
    """Remove the temporary folders of killed processes, which are those that are not locked."""
    root = Path(gettempdir())
    if fcntl is None or no_locks(root):
        return
    for folder in root.glob(f"{TEMPORARY}*"):
        with suppress(OSError):
            if folder.lstat().st_uid == os.getuid():
                opened = os.open(folder, os.O_RDONLY)
                try:
                    if take_lock(opened):
                        shutil.rmtree(folder, ignore_errors=True)
                finally:
                    os.close(opened)


RECORD = "run.mcap"  # name of the record in a run's folder


def record_in(folder: Path) -> Path:
    """Return the path of the record in a run's folder.

    Raises:
        RunError: the folder contains no record.
    """
    record = folder / RECORD
    if not record.is_file():
        raise RunError(f"{folder}: contains no {RECORD}; give the folder of a run, as `zsim run` printed it")
    return record


def record_at(path: Path) -> Path:
    """Return the path of a record, given that path or a run's folder (see `record_in`)."""
    return path if path.is_file() else record_in(path)
