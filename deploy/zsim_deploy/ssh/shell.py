"""Words for a POSIX shell on another host."""

import shlex
from collections.abc import Iterable


def word(path: str) -> str:
    """Return a path as one word of a shell; a leading ~/ stays the home of the user there."""
    return f"~/{shlex.quote(path[2:])}" if path.startswith("~/") else shlex.quote(path)


def line(words: Iterable[str]) -> str:
    """Return a command line."""
    return " ".join(map(word, words))
