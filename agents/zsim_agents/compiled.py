"""Compile plain-float mathematics with numba where it is installed; elsewhere the same source runs as Python.

Numba is asked for neither fast mathematics nor fused operations, so both ways give the same bits. What it compiles
is kept on disk between runs. Its own cache looks only at the file of a function, although what the function calls
is compiled into it, so the key here covers all files with compiled functions.
"""

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from zsim import encoding

Function = TypeVar("Function", bound=Callable[..., Any])

SOURCES = (  # every file that uses `compiled`
    "aiding_models.py",
    "cluster_frame.py",
    "cluster_space.py",
    "dead_reckoning.py",
    "estimator_fusion.py",
    "estimator_motion.py",
    "estimator_rows.py",
    "flight_judge.py",
    "formation.py",
    "gate_reader.py",
    "kalman_update.py",
    "madgwick.py",
    "near_pairs.py",
    "pair_cluster.py",
    "reference_check.py",
    "rotation_fit.py",
    "template_cluster.py",
    "trajectory.py",
    "triad_cluster.py",
)
CONSTANTS = ("aiding.py", "estimator_prior.py", "strapdown.py")  # files of which constants are compiled in
SHARED = (encoding,)  # modules of other packages whose functions are compiled

try:
    import numba
    from numba.core.caching import FunctionCache
except ImportError:
    numba = FunctionCache = None


COMPILES = numba is not None  # whether `compiled` compiles here


def sources_digest(folder: Path = Path(__file__).parent) -> str:
    """Return the SHA-256 of the files with compiled functions, or with constants of theirs."""
    files = [folder / name for name in SOURCES + CONSTANTS] + [Path(str(module.__file__)) for module in SHARED]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


_DIGEST = sources_digest()


def compiled(function: Function) -> Function:
    """Return `function` compiled, cached on disk if there is a place for it."""
    if numba is None:
        return function
    dispatcher: Any = numba.njit(function)
    if dispatcher is not function:  # it is under NUMBA_DISABLE_JIT=1
        with contextlib.suppress(RuntimeError):  # neither package nor home can be written: compile at each start
            dispatcher._cache = _cache(function)
    return dispatcher


def _cache(function: Callable[..., Any]) -> Any:
    """Return numba's cache of a function with the digest of all sources in its key."""
    assert FunctionCache is not None
    cache: Any = FunctionCache(function)
    key = cache._index_key
    cache._index_key = lambda signature, codegen: (*key(signature, codegen), _DIGEST)
    return cache
