"""Compile plain-float mathematics with numba where it is installed; elsewhere the same source runs as Python.

Numba is asked for neither fast mathematics nor fused operations, so both ways give the same bits.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

try:
    import numba
except ImportError:
    numba = None


def compiled(function: Function) -> Function:
    """Return `function` compiled, kept in numba's cache between runs if there is a place for it."""
    if numba is None:
        return function
    try:
        return cast(Function, numba.njit(cache=True)(function))
    except RuntimeError:  # numba's answer when neither the package's folder nor the home can be written
        return cast(Function, numba.njit(function))
