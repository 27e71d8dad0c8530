"""What every process of a federation shares: frames, keys, messages, scenario, record, session, agent.

Rooms from the ground up: errors; math and schema; sensors; contract; vehicles; record, scenario and transport, which do
not import each other; runtime; presentation. A room imports those below it. Nothing here imports another package of the
product: what users call as `zsim.run` and so on is `zsim_api`'s, imported when it is first asked for.
"""

import importlib
from contextlib import suppress
from pathlib import Path
from typing import Any

RELEASE = "0.2.0"  # as in pyproject.toml
CONTRACT = 1
COMMIT_FILE = "commit.txt"  # of an archive that git has made, of an sdist and of a wheel
DIGITS = 8  # of a commit in a version: none of two in a repository of this size are alike


def commit(package: Path = Path(__file__).parent) -> str:
    """Return the commit of a package `zsim` in hex digits, from git's files or from the build; empty if neither has it.

    No program is started for it: it is read at every start of every process.
    """
    with suppress(OSError):
        if found := _checked_out(package.parent / ".git"):
            return found
    with suppress(OSError):
        found = (package / COMMIT_FILE).read_text().strip()
        return "" if "$" in found else found  # a checkout has the placeholder that `git archive` fills
    return ""


def _checked_out(git: Path) -> str:
    """Return the commit of a checkout, whose `.git` is a folder, or a file in a worktree (gitrepository-layout(5))."""
    if git.is_file():
        git = git.parent / git.read_text().removeprefix("gitdir:").strip()
    head = (git / "HEAD").read_text().strip()
    if not head.startswith("ref: "):
        return head
    reference = head.removeprefix("ref: ")
    shared = git / "commondir"
    common = git / shared.read_text().strip() if shared.exists() else git
    with suppress(FileNotFoundError):
        return (common / reference).read_text().strip()
    with suppress(FileNotFoundError):
        for line in (common / "packed-refs").read_text().splitlines():
            if line.endswith(f" {reference}"):
                return line.partition(" ")[0]
    return ""


__version__ = f"{RELEASE}+g{found[:DIGITS]}" if (found := commit()) else RELEASE

_LIBRARY = "zsim_api"  # imported when one of its names is first asked for; type checkers read __init__.pyi


def __getattr__(name: str) -> Any:
    """Return a name of the library for Python."""
    if not name.startswith("_") and name in (library := importlib.import_module(_LIBRARY)).__all__:
        globals()[name] = found = getattr(library, name)
        return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *importlib.import_module(_LIBRARY).__all__})
