"""Compilation of plain-float mathematics with numba, and named columns of rows.

Without numba, the same source runs as Python. Compiled code uses no fast-math and no fused operations, so that the same
input gives the same bits, compiled or not.

    inlined     part of a kernel that takes array views, floats and tuples, and allocates no array
    noinline    the same, but rarely run, and so not inlined into its caller
    compiled    part of a kernel that may allocate arrays
    kernel      called from Python and cached on disk; 1 / 0 is inf, as in numpy
    portable    called from Python and cached on disk; 1 / 0 raises ZeroDivisionError, as in Python
    deferred    a kernel that runs as Python until other code has imported numba
    columns     names of the columns of a row of numbers, which compiled code reads as constants

Numba's own disk cache depends only on the file of a function, although everything that the function calls is compiled
into it. So the name of a cache entry includes a digest of every file that its module imports, directly or indirectly.

An `inlined` function owns no reference-counted array: numba's atomic reference counts of views would take a fifth of a
gate's time, and calls of functions that are not inlined another fifth.
"""

import hashlib
import os
import re
import stat
import sys
import tempfile
from collections import namedtuple
from collections.abc import Callable, Iterable
from functools import cache, cached_property, partial, update_wrapper
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])
COMPILES = find_spec("numba") is not None  # whether functions are compiled
_EXACT: dict[str, Any] = {"error_model": "numpy", "fastmath": False}
_UNCOUNTED: dict[str, Any] = {"_nrt": False}  # numba's option to omit reference counts; forbids allocating arrays
_IMPORTS = re.compile(r"^from (zsim[\w.]*) import (\([^)]*\)|.*)$", re.MULTILINE)
_NAME = re.compile(r"\w+")


def cache_folder() -> str:
    """Return a folder for compiled code if numba has none of its own; empty if it has, or if no folder is available.

    Numba caches compiled code in the source's folder or in the user's cache. If neither is writable, as in many
    containers and for users without a home, every process would compile everything again; and without HOME, the cache
    of a user unknown to the system is a folder named `~` in the current one. Code in the folder is executed, so no
    other user may write there.
    """
    home_cache = Path(os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache")), "numba")
    if _is_writable(Path(__file__).parent / "__pycache__") or (home_cache.is_absolute() and _is_writable(home_cache)):
        return ""
    for base in ("/var/tmp", tempfile.gettempdir()):
        folder = Path(base, f"zsim-{os.getuid()}-compiled")
        try:
            folder.mkdir(0o700, exist_ok=True)
            status = folder.lstat()
        except OSError:
            continue
        is_ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022
        if is_ours and _is_writable(folder):
            return str(folder)
    return ""


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


@cache
def _numba() -> Any:
    """Return numba, imported when the first function is compiled: importing takes a third of a second."""
    if not COMPILES:
        return None
    import numba
    from numba.extending import typeof_impl

    if hasattr(os, "getuid"):  # not on Windows
        numba.config.CACHE_DIR = numba.config.CACHE_DIR or cache_folder()  # type: ignore[attr-defined]

    @typeof_impl.register(Part)
    def _(function: Part, _context: Any) -> Any:  # pyright: ignore[reportUnusedFunction]
        return numba.types.Dispatcher(function.dispatcher)

    return numba


def _compile(function: Function, options: dict[str, Any]) -> Function:
    numba = _numba()
    dispatcher: Any = function if numba is None else numba.njit(**options)(function)
    return dispatcher


class Part:
    """A function called by kernels, compiled without a Python entry point, which takes a quarter of the compile time.

    For calls from Python, it is compiled separately with an entry point, and cached on disk like a kernel.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self.py_func = function
        self._options = options

    @cached_property
    def dispatcher(self) -> Any:
        """The version that compiled code calls."""
        return _compile(self.py_func, {**self._options, "no_cpython_wrapper": True, "no_cfunc_wrapper": True})

    @cached_property
    def _entered(self) -> Any:
        return _kept(self.py_func, self._options)

    def __call__(self, *arguments: Any) -> Any:
        return self._entered(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__name__


def _part(function: Function, options: dict[str, Any]) -> Function:
    part: Any = Part(function, options) if COMPILES else function
    return part


def compiled(function: Function) -> Function:
    return _part(function, _EXACT)


def inlined(function: Function) -> Function:
    return _part(function, {**_EXACT, **_UNCOUNTED, "forceinline": True})


def noinline(function: Function) -> Function:
    return _part(function, {**_EXACT, **_UNCOUNTED})


def _kept(function: Function, options: dict[str, Any]) -> Function:
    """Return a function whose compiled code is cached on disk, under a name that changes with any of its sources."""
    if not COMPILES:
        return function
    version = _digest_of_module(function.__module__)
    function.__qualname__ = f"{function.__qualname__}_{version}"
    try:
        dispatcher: Any = _compile(function, {**options, "cache": True})
    except RuntimeError:  # neither the source's folder nor the user's cache is writable
        return _compile(function, options)
    if dispatcher is not function:  # the same if NUMBA_DISABLE_JIT is set
        dispatcher.compile = partial(_compile_once, dispatcher, dispatcher.compile)
    return dispatcher


def _compile_once(dispatcher: Any, compile_for: Callable[[Any], Any], signature: Any) -> Any:
    """Compile a kernel in one process per machine, while others that need it wait and then load the result.

    The processes of a run start together, and would each compile the same code for half a minute.
    """
    if is_kept(dispatcher):
        return compile_for(signature)
    from numba.core.compiler_lock import global_compiler_lock

    from zsim.output_folder import wait_for_lock  # imported here, since imports at the top count as a kernel's sources

    lock = Path(dispatcher.stats.cache_path, f"{dispatcher.__qualname__}.lock")
    # numba's lock first: a thread that holds it may need a kernel that another thread is about to compile
    with global_compiler_lock, open(lock, "w") as file:
        wait_for_lock(file)
        try:
            return compile_for(signature)
        finally:
            lock.unlink(missing_ok=True)  # no longer needed: the code is cached


def kernel(makes_arrays: bool = True) -> Callable[[Function], Function]:
    """Return a decorator; `makes_arrays` is False if the kernel and all that it calls allocate no arrays."""
    options = _EXACT if makes_arrays else {**_EXACT, **_UNCOUNTED}
    return lambda function: _kept(function, options)


def portable(function: Function) -> Function:
    return _kept(function, {})


class Deferred(Part):
    """A kernel that runs as Python, with identical results, until other code has imported numba."""

    @cached_property
    def dispatcher(self) -> Any:
        return _kept(self.py_func, self._options)

    def __call__(self, *arguments: Any) -> Any:
        return (self.dispatcher if "numba" in sys.modules else self.py_func)(*arguments)


def deferred(makes_arrays: bool = True) -> Callable[[Function], Function]:
    """Return a decorator as `kernel` does, for mathematics that is also used while a run is set up."""
    options = _EXACT if makes_arrays else {**_EXACT, **_UNCOUNTED}
    decorator: Any = lambda function: Deferred(function, options) if COMPILES else function  # noqa: E731
    return decorator


def is_kept(function: Callable[..., Any]) -> bool:
    """Return whether a kernel compiled from its current sources is on disk, so that it only needs to be loaded."""
    stats = getattr(function, "stats", None)  # of numba's dispatcher
    folder = stats and stats.cache_path
    return bool(folder) and any(Path(folder).glob(f"*{function.__qualname__}*.nbc"))


@cache
def _digest_of_module(module: str) -> str:
    return digest(sources(module))


def sources(module: str) -> frozenset[Path]:
    """Return the files of a module and of all zsim modules that it imports at the top, directly or indirectly."""
    reached: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += _imported(name)
    return frozenset(Path(str(sys.modules[name].__file__)) for name in reached)


@cache
def _imported(module: str) -> tuple[str, ...]:
    """Return the modules of zsim that a loaded module imports."""
    text = Path(str(sys.modules[module].__file__)).read_text(encoding="utf-8")
    lines = _IMPORTS.findall(text)  # packages, with the modules or names imported from each
    found = [name for package, names in lines for name in (package, *(f"{package}.{n}" for n in _NAME.findall(names)))]
    return tuple(name for name in found if getattr(sys.modules.get(name), "__file__", None))


def digest(files: Iterable[Path]) -> str:
    """Return a hash of the files' contents, independent of their folders."""
    return hashlib.sha256(b"".join(sorted(map(_text, files)))).hexdigest()[:12]


@cache
def _text(path: Path) -> bytes:
    return path.read_bytes()


class Field(NamedTuple):
    """A named group of numbers in a row, its unit ("1" if dimensionless), and its width."""

    name: str
    unit: str
    width: int = 1


class Columns(Protocol):
    """The first column of each field by name, and the number of columns as `size`."""

    def __getattr__(self, name: str) -> int: ...


def columns(name: str, fields: Iterable[Field]) -> Columns:
    """Return the first column of every field by name, and the total number of columns as `size`.

        STATE = columns("State", (Field("p_WB", "m", 3), Field("q_WB", "1", 4), Field("energy", "J")))
        row[STATE.p_WB : STATE.p_WB + 3]      row[STATE.energy]      np.zeros((count, STATE.size))

    The result is a named tuple of integers, whose attributes compiled code reads as constants.

    Raises:
        ValueError: two fields have the same name.
    """
    listed = tuple(fields)
    first = [0, *accumulate(field.width for field in listed)]
    column_type: Any = namedtuple(name, [*(field.name for field in listed), "size"])  # type: ignore[misc]
    return column_type(*first)
