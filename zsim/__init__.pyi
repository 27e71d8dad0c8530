"""For type checkers and editors: beside its own names, `zsim` passes on those of `zsim_api` when they are asked for."""

from pathlib import Path

from zsim_api import *  # noqa: F403

RELEASE: str
CONTRACT: int
COMMIT_FILE: str
DIGITS: int
__version__: str

def commit(package: Path = ...) -> str: ...
