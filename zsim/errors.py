"""The errors of zsim, with one line per fault (where, found, allowed, remedy), and texts derived from errors."""

import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path
from types import TracebackType

PACKAGES = frozenset({"zsim", "zsim_world", "zsim_agents", "zsim_bridges", "zsim_analysis", "zsim_api", "zsim_deploy"})
"""The packages of zsim; all other modules belong to users or libraries."""


class ZsimError(Exception):
    """Base of all errors that a user can cause; the command line prints them without a traceback."""

    def _render_traceback_(self) -> list[str]:
        """Return the traceback for IPython, which calls this method: only the user's frames, and the error's text."""
        from IPython import get_ipython  # pyright: ignore[reportPrivateImportUsage]

        frames = list(takewhile(lambda each: _package(each) not in PACKAGES, _entries(self.__traceback__)))
        while frames and _package(frames[-1]) in sys.stdlib_module_names:  # frames through which zsim calls itself
            frames.pop()
        traceback: TracebackType | None = None
        for each in reversed(frames):
            traceback = TracebackType(traceback, each.tb_frame, each.tb_lasti, each.tb_lineno)
        chained = self.__cause__, self.__suppress_context__
        self.__cause__ = None
        try:
            return get_ipython().InteractiveTB.structured_traceback(type(self), self, traceback)
        finally:
            self.__cause__, self.__suppress_context__ = chained


def _entries(traceback: TracebackType | None) -> Iterator[TracebackType]:
    while traceback is not None:
        yield traceback
        traceback = traceback.tb_next


def _package(entry: TracebackType) -> str:
    return entry.tb_frame.f_globals.get("__name__", "").partition(".")[0]


class DocumentError(ZsimError):
    """A faulty document; `faults` has a line for each fault."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults


class NotTrustedError(DocumentError):
    """A document names user code that this command must not import."""


class ScenarioError(DocumentError):
    """A faulty scenario or override of a scenario."""


class InventoryError(DocumentError):
    """A faulty inventory of hosts."""


class DecodeError(ZsimError):
    """A payload that cannot be decoded; the text states key, field, and the values found and allowed."""


class BadNameError(ZsimError):
    """A name outside `[a-z0-9_.-]{1,32}`."""


class SessionError(ZsimError):
    """A Zenoh session cannot be opened or used."""


class NoListenerError(SessionError):
    """No process listens on an endpoint yet; connecting may succeed later."""


class NoWorldError(SessionError):
    """No world answered a query within the time limit, or its answer was unusable."""


class RunError(ZsimError):
    """A run that could not start or did not end well."""


class SupersededError(RunError):
    """Another process with the same name has replaced this one."""


class BehindError(RunError):
    """A participant needs messages that are no longer kept; a new incarnation can continue."""


class RequestRefusedError(RunError):
    """A request was refused."""


class RunFailedError(RunError):
    """A failure ended the run early."""


class UserCodeError(RunFailedError):
    """A user's class raised an exception or returned an invalid value.

    Args:
        text: class and method, and the line in the user's file or the value.
        where: process and simulated time; empty until known.
    """

    def __init__(self, text: str, where: str = "") -> None:
        super().__init__(f"{where}: {text}" if where else text)
        self.text = text
        self.where = where

    def __reduce__(self) -> tuple[type["UserCodeError"], tuple[str, str]]:
        return type(self), (self.text, self.where)


class HostsError(ZsimError):
    """Hosts that cannot be reached or lack a requirement; a line per host with the failure and its remedy."""


class RecordError(ZsimError):
    """A record that cannot be written or read."""


class ReportError(ZsimError):
    """A report that cannot be created or written."""


OTHER_OUT = "give --out another folder"  # remedy


@contextmanager
def file_fault(path: Path, fault: str, remedy: str, kind: type[ZsimError] = RunError) -> Iterator[None]:
    """Convert an OSError on a file into an error of one line: `PATH: FAULT (REASON); REMEDY`."""
    try:
        yield
    except OSError as error:
        raise kind(f"{path}: {fault} ({error.strerror}); {remedy}") from error


# control codes C0 (except tab and line feed) and C1, and bidirectional controls
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Return a text for a terminal with its control codes escaped, since text from the network may contain some."""
    return CONTROL.sub(lambda match: ascii(match[0])[1:-1], text)


_NUMBER = re.compile(r"(?<![\w.:-])-?\d+(\.\d+)?(e[-+]?\d+)?(?![\w:]|\.\d)")  # a number that is not part of a name
REASON_MAX = 300  # maximum number of characters of a reason


def reason_of(error: BaseException) -> str:
    """Return the message of an exception on one line, preceded by its type unless it is zsim's."""
    text = " ".join(str(error).split())[:REASON_MAX]
    return text if isinstance(error, ZsimError) and text else f"{type(error).__name__}: {text}"


def without_numbers(text: str) -> str:
    """Return a reason with its numbers replaced by #, except in names, to compare reasons regardless of numbers."""
    return _NUMBER.sub("#", text)


# The smallest extra of pyproject.toml that installs a module, by the module's import name.
EXTRA_OF = {
    "aiohttp": "gateway",
    "asyncssh": "hosts",
    "av": "video",
    "cloudpickle": "agents",
    "cryptography": "hosts",
    "cv2": "cameras",
    "distributed": "dask",
    "fmpy": "fmu",
    "foxglove": "export",
    "gymnasium": "env",
    "jinja2": "report",
    "matplotlib": "report",
    "mcap": "record",
    "numba": "agents",
    "pandas": "python",
    "pettingzoo": "env",
    "pyarrow": "export",
    "pypcd4": "obstacles",
    "rosbags": "ros2",
    "scipy": "agents",
    "trimesh": "obstacles",
    "viser": "console",
    "xarray": "notebook",
    "xxhash": "ros2",
    "zstandard": "record",
}


def install_command(extras: Iterable[str]) -> str:
    """Return the command that installs extras from the checkout, since zsim is not on a package index."""
    names = ",".join(sorted(set(extras)))
    checkout = Path(__file__).parents[1]
    if not (checkout / "pyproject.toml").exists():
        return f"pip install '.[{names}]' in a checkout of zsim"
    inside = {path: os.path.relpath(path) for path in (sys.executable, str(checkout))}
    python, folder = (path if relative.startswith("..") else relative for path, relative in inside.items())
    return f"{python} -m pip install -e '{folder}[{names}]'"


def missing(error: ModuleNotFoundError) -> str | None:
    """Return a line about a missing module with the command that installs it; None if no extra installs it."""
    module = (error.name or "").partition(".")[0]
    extra = EXTRA_OF.get(module)
    return f"{module} is not installed; {install_command([extra])}" if extra else None


@contextmanager
def what_is_missing() -> Iterator[None]:
    """Convert the error about a missing module into a RunError with the command that installs it, if an extra does."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (lacking := missing(error)) is None:
            raise
        raise RunError(lacking) from error
