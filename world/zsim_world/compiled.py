"""How this package compiles: no fast-math, so that the same input gives the same bits.

Division by zero gives inf as in numpy: a diverged state is found at the end of a gate, not by an exception inside.
What is `compiled` or `inlined` becomes part of its caller. Only a `kernel`, called from Python, is kept on disk:
numba's own cache looks at the file of a function alone, so its name there carries the digest of every file that is
compiled into it.

An `inlined` function takes views of arrays, floats and tuples of them, and makes no array. So nothing in it has an
owner to be counted: the atomic counts that numba keeps for every view took a fifth of a gate's time, calls of functions
that were not inlined another.
"""

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from numba import njit

_EXACT: dict[str, Any] = {"error_model": "numpy", "fastmath": False}
_UNCOUNTED: dict[str, Any] = {
    "_nrt": False
}  # numba's name for doing without its counts; making an array is then refused

compiled = njit(**_EXACT)
inlined = njit(**_EXACT, **_UNCOUNTED, forceinline=True)
apart = njit(**_EXACT, **_UNCOUNTED)  # for what is rarely run: it does not crowd its caller's code


def kernel(sources: Iterable[Path], makes_arrays: bool = True) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of a function that is compiled once per machine.

    Args:
        sources: every file that is compiled into it, for its functions or for its constants.
        makes_arrays: False for one that, as all that it calls, only works on the arrays that it is given.
    """

    options = _EXACT if makes_arrays else {**_EXACT, **_UNCOUNTED}

    def compile_(function: Callable[..., Any]) -> Any:
        function.__qualname__ = f"{function.__qualname__}_{digest(sources)}"
        try:
            return njit(**options, cache=True)(function)
        except RuntimeError:  # neither beside its file nor in the user's cache may anything be written
            return njit(**options)(function)

    return compile_


def is_kept(function: Callable[..., Any]) -> bool:
    """Tell whether a compilation of this kernel, as its sources are now, is on disk; it is then only loaded."""
    stats = getattr(function, "stats", None)  # of numba's dispatcher
    folder = stats and stats.cache_path
    return bool(folder) and any(Path(folder).glob(f"*{function.__qualname__}*.nbc"))


def digest(sources: Iterable[Path]) -> str:
    """Return what changes with the text of any of the files."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
