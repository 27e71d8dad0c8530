"""For type checkers and editors: beside its own names, `zsim` provides those of `zsim_api`."""

from pathlib import Path

from zsim_api import *  # noqa: F403

RELEASE: str
CONTRACT: int
COMMIT_FILE: str
DIGITS: int
__version__: str

def commit(package: Path = ...) -> str: ...
