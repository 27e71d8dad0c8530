"""How this package compiles: no fast-math, so that the same input gives the same bits.

Division by zero gives inf as in numpy: a diverged state is found at the end of a gate, not by an exception inside.
What `compiled` functions call is compiled into their caller. Only a `kernel`, called from Python, is kept on disk:
numba's own cache looks at the file of a function alone, so its name there carries the digest of every file that is
compiled into it.
"""

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from numba import njit

compiled = njit(error_model="numpy", fastmath=False)


def kernel(sources: Iterable[Path]) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of a function that is compiled once per machine.

    Args:
        sources: every file that is compiled into it, for its functions or for its constants.
    """

    def compile_(function: Callable[..., Any]) -> Any:
        function.__qualname__ = f"{function.__qualname__}_{digest(sources)}"
        try:
            return njit(error_model="numpy", fastmath=False, cache=True)(function)
        except RuntimeError:  # neither beside its file nor in the user's cache may anything be written
            return compiled(function)

    return compile_


def is_kept(function: Callable[..., Any]) -> bool:
    """Tell whether a compilation of this kernel, as its sources are now, is on disk; it is then only loaded."""
    stats = getattr(function, "stats", None)  # of numba's dispatcher
    folder = stats and stats.cache_path
    return bool(folder) and any(Path(folder).glob(f"*{function.__qualname__}*.nbc"))


def digest(sources: Iterable[Path]) -> str:
    """Return what changes with the text of any of the files."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
