"""The code shared by all processes of a federation: frames, keys, messages, scenario, record, session, agent.

Modules and packages from the bottom up: errors and output_folder; math and schema; sensors; contract; vehicles; record,
scenario and transport, which do not import each other; runtime; presentation. Each imports only those below it, and
none imports another package of the product: what users call as `zsim.run` etc. belongs to `zsim_api`, which is imported
when first used.
"""

import importlib
from contextlib import suppress
from pathlib import Path
from typing import Any

RELEASE = "0.2.0"  # as in pyproject.toml
CONTRACT = 1
COMMIT_FILE = "commit.txt"  # file with the commit in git archives, sdists and wheels
DIGITS = 8  # digits of the commit in the version; enough to be unique in a repository of this size


def commit(package: Path = Path(__file__).parent) -> str:
    """Return the commit of the `zsim` package in hex digits, from git's files or the build; empty if neither states it.

    git itself is not run, since every process reads the commit when it starts.
    """
    with suppress(OSError):
        if found := _checked_out(package.parent / ".git"):
            return found
    with suppress(OSError):
        found = (package / COMMIT_FILE).read_text().strip()
        return "" if "$" in found else found  # a checkout has the placeholder that `git archive` replaces
    return ""


def _checked_out(git: Path) -> str:
    """Return the commit of a checkout; `git` is a folder or, in a worktree, a file (gitrepository-layout(5))."""
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

_LIBRARY = "zsim_api"  # imported when one of its names is first used; type checkers read __init__.pyi


def __getattr__(name: str) -> Any:
    """Return a public name of `zsim_api`, importing it if necessary."""
    if not name.startswith("_") and name in (library := importlib.import_module(_LIBRARY)).__all__:
        globals()[name] = found = getattr(library, name)
        return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *importlib.import_module(_LIBRARY).__all__})
