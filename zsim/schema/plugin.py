"""User code named in a document: `package.module`, `package.module:Class` or `package.module:function`.

Modules are found as usual in Python: installed, or on PYTHONPATH. The folder of the document is searched last
(`search`), so that a module there needs no installation on that machine and cannot hide an installed module. On other
hosts the module must be installed.

Importing a module runs it: fly other people's scenarios only if you trust their modules. Commands that only read
documents look up names without importing anything (`names_only`).
"""

import ast
import importlib
import json
import os
import re
import sys
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.machinery import ModuleSpec, PathFinder
from inspect import Parameter, getattr_static, isclass, isfunction, signature
from itertools import accumulate
from pathlib import Path
from traceback import walk_tb
from types import FrameType, ModuleType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from zsim import errors
from zsim.errors import PACKAGES, DocumentError, NotTrustedError, UserCodeError, reason_of
from zsim.schema.checker import show

Object = TypeVar("Object")
FOLDERS = "ZSIM_PLUGIN_PATH"  # environment variable, so that child processes search there too
IMPORTS, NO_IMPORTS = "ZSIM_PLUGIN_IMPORTS", "no"  # environment variable, likewise, and its value that forbids imports
NO_LOOKUP = "unseen"  # value that also forbids looking up names
WHERE = "install it, or put it on PYTHONPATH or in the scenario's folder"

MADE = "zsim_own_"  # prefix of modules generated for code in notebooks and scripts: zsim_api.own_code
LIBRARIES = tuple(f"{sysconfig.get_path(part)}{os.sep}" for part in ("stdlib", "purelib", "platlib"))

MODULE_NAME = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*\Z"
CLASS_NAME = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*\Z"


def search(*paths: Path) -> None:
    """Set the folders of the current document, in which this process and its children search for modules.

    Former folders are replaced, so that the environment of a program that reads many documents does not grow.

    Args:
        paths: folders, the document's first; missing folders are ignored.
    """
    existing = dict.fromkeys(str(path.resolve()) for path in paths if path.is_dir())
    os.environ[FOLDERS] = json.dumps([*existing])  # a folder's name may contain any separator


def folders() -> tuple[Path, ...]:
    return tuple(map(Path, json.loads(os.environ.get(FOLDERS) or "[]")))


def beside(name: str) -> Path:
    """Return the path of a file named in a scenario, in a folder of its modules or in the working directory."""
    candidates = [folder / name for folder in (*folders(), Path())]
    return next((path for path in candidates if path.is_file()), candidates[0])


@contextmanager
def names_only(wanted: bool = True, looked_up: bool = True) -> Iterator[list[str]]:
    """Prevent imports of modules named in documents, in this process and its children, unless `wanted` is False.

    Args:
        wanted: whether to prevent imports.
        looked_up: whether names are looked up, so that an unknown name is a fault, as with imports.

    Yields:
        the names that were not imported; empty if imports are allowed.
    """
    former, _SKIPPED[:] = os.environ.get(IMPORTS), []
    if wanted:
        os.environ[IMPORTS] = NO_IMPORTS if looked_up else NO_LOOKUP
    try:
        yield _SKIPPED
    finally:
        os.environ.pop(IMPORTS, None)
        if former is not None:
            os.environ[IMPORTS] = former


def may_import() -> bool:
    return os.environ.get(IMPORTS) not in (NO_IMPORTS, NO_LOOKUP)


def load(name: str, where: str, kind: type, is_constructed: bool = False) -> Callable[..., Any]:
    """Return the class named `package.module:Class`.

    Args:
        where: file and path of the field that names the class, for the error.
        kind: class or Protocol whose public methods the class must have.
        is_constructed: whether its constructor must take the same arguments as that of `kind`.

    Raises:
        DocumentError: the module or class does not exist, or a method is missing or takes other arguments.
        NotTrustedError: importing the class is not allowed.
    """
    loaded = _attribute(name, where, "Class", isclass)
    methods = [method for method in dir(kind) if not method.startswith("_") and callable(getattr(kind, method))]
    own = {method: getattr(loaded, method, None) for method in methods}
    missing = [m for m, each in own.items() if not callable(each) or getattr(each, "__isabstractmethod__", False)]
    if missing:
        lacks = f"{where} is {show(name)}, which has no {', '.join(missing)}()"
        raise DocumentError([f"{lacks}; must have the methods of {kind.__name__.removesuffix('Methods')}"])
    for method in ["__init__", *methods] if is_constructed else methods:
        if (mismatch := _other_arguments(loaded, kind, method)) is not None:
            actual, expected = mismatch
            fault = f"{where} is {show(name)}, whose {method} takes ({actual})"
            raise DocumentError([f"{fault}; must take ({expected}), as that of {kind.__name__}"])
    return loaded


def load_function(name: str, where: str) -> Callable[..., Any]:
    """Return the function named `package.module:function`; arguments and errors as for `load`."""
    return _attribute(name, where, "function", callable)


def load_any(name: str, where: str, kind: type) -> Any:
    """Return the class, function or instance of `kind` named `package.module:Name`; errors as for `load`."""
    return _attribute(name, where, "class", lambda value: callable(value) or isinstance(value, kind))


def load_module(name: str, where: str) -> ModuleType:
    """Return the module named `package.module`; errors as for `load`."""
    return _imported(name, f"{where} is {show(name)}")


def load_object(name: str, where: str, attribute: str, kind: type[Object]) -> Object:
    """Return the instance of `kind` that a module `package.module` defines as `attribute`; errors as for `load`."""
    value = getattr(load_module(name, where), attribute, None)
    if not isinstance(value, kind):
        holds = f"whose {attribute} is {show(type(value).__name__)}" if value else f"which defines no {attribute}"
        raise DocumentError([f"{where} is {show(name)}, {holds}; must be a {kind.__module__}.{kind.__name__}"])
    return value


def is_own(kind: type) -> bool:
    """Return whether a class belongs to a user, not to zsim."""
    return kind.__module__.partition(".")[0] not in PACKAGES


def is_library(path: str) -> bool:
    """Return whether a file belongs to Python or an installed package."""
    return path.startswith(LIBRARIES) or "site-packages" in path or "dist-packages" in path


def full_name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


RAISED = (Exception, SystemExit)
"""Exceptions of user code that end a run with an error; an exit would otherwise go unreported."""


def user_code_error(error: BaseException, where: str) -> UserCodeError | None:
    """Return an exception of user code as an error that names method, file and line; None for other exceptions.

    Args:
        error: exception whose traceback begins in zsim, where it was caught.
        where: process and simulated time, for the text.
    """
    if isinstance(error, UserCodeError):
        return UserCodeError(error.text, error.where or where)  # a new error, to be raised from `error`
    walked = list(walk_tb(error.__traceback__))
    frames = [(frame, line) for frame, line in walked if is_user_frame(frame)]
    if not frames:
        return None
    if isinstance(error, SystemExit) and walked[-1][0].f_globals.get("__name__", "").partition(".")[0] in PACKAGES:
        return None  # raised by zsim's signal handler during a user's call
    (called, _), (deepest, line) = frames[0], frames[-1]
    method = f"{called.f_globals.get('__name__', '')}:{called.f_code.co_qualname}"
    raised = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    return UserCodeError(f"{method} raised {raised} ({_location(deepest.f_code.co_filename, line)})", where)


def innermost_line(frame: FrameType | None) -> str:
    """Return file and line of the innermost user code on a frame's stack, in parentheses; empty without any."""
    while frame and not is_user_frame(frame):
        frame = frame.f_back
    return f" ({_location(frame.f_code.co_filename, frame.f_lineno)})" if frame else ""


def is_user_frame(frame: FrameType) -> bool:
    """Return whether a frame is in a user's file or notebook, or in an installed package named in a document."""
    package, path = frame.f_globals.get("__name__", "").partition(".")[0], frame.f_code.co_filename
    if package in PACKAGES or (path.startswith("<") and package != "__main__"):
        return False
    return not is_library(path) or package in _LOADED


def numbers(returned: Any) -> NDArray[np.float64]:
    """Return a result of user code as an array; ValueError if it is not a regular array of real numbers."""
    array = np.asarray(returned)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"not real numbers: {array.dtype}")
    return array.astype(float, copy=False)


def raised_by_user(failure: UserCodeError) -> BaseException | None:
    """Return the exception that user code raised, with its traceback cut to begin there; None if user code raised none.

    For caught failures only, since the traceback of the returned exception is modified.
    """
    raised: BaseException | None = failure
    while raised is not None:
        traceback = raised.__traceback__
        while traceback and not is_user_frame(traceback.tb_frame):
            traceback = traceback.tb_next
        if traceback and not isinstance(raised, UserCodeError):
            return raised.with_traceback(traceback)
        raised = raised.__cause__
    return None


_CELL = re.compile(r".*ipykernel_\d+[/\\]\d+\.py|<ipython-input-(\d+)-.*>")


def _location(path: str, line: int) -> str:
    """Return file and line, or a notebook's cell and line, as text."""
    cell = _CELL.fullmatch(path)
    if cell is None:
        return f"{path.removeprefix(f'{os.getcwd()}{os.sep}')}:{line}"
    notebook = sys.modules.get("IPython")  # absent outside IPython and notebooks
    shell = notebook.get_ipython() if notebook else None
    formatted = shell.compile.format_code_name(path) if shell else None
    number = f"In[{cell[1]}]" if cell[1] else formatted[1] if formatted else "of the notebook"
    return f"cell {number}, line {line}"


_LOADED: set[str] = set()  # packages named in documents
_SKIPPED: list[str] = []  # names in documents that were not imported


def _attribute(name: str, where: str, kind: str, is_kind: Callable[[Any], bool]) -> Any:
    """Return the class or function named `package.module:attribute`; errors as for `load`."""
    module_name, colon, attribute = name.partition(":")
    if not (colon and module_name and attribute):
        raise DocumentError([f"{where} is {show(name)}; must be package.module:{kind}"])
    module = _imported(module_name, f"{where} is {show(name)}", attribute)
    value = getattr(module, attribute, None)
    if not is_kind(value):
        if module_name.startswith(MADE):  # the user passed an object in Python, not a name
            raise DocumentError([f"{where} is {show(value)}; must be a {kind.lower()}, or a name, e.g. module:{kind}"])
        is_one = isfunction if kind == "function" else isclass
        own = [each for each in vars(module).values() if is_one(each) and each.__module__ == module.__name__]
        names = sorted(each.__name__ for each in own if not each.__name__.startswith("_"))
        allowed = f"must be a {kind.lower()} of {module_name}: {', '.join(names) or 'it has none'}"
        raise DocumentError([f"{where} is {show(name)}; {allowed}"])
    return value


def _imported(name: str, label: str, attribute: str = "") -> ModuleType:
    """Import a module if allowed; otherwise check that it exists and that its source defines `attribute`."""
    package = name.partition(".")[0]
    if not may_import() and package not in PACKAGES:
        if os.environ[IMPORTS] != NO_LOOKUP:
            _find(name, label, attribute)
        full = f"{name}:{attribute}" if attribute else name
        if full not in _SKIPPED:
            _SKIPPED.append(full)
        raise NotTrustedError([f"{label}, code that comes with the document and is imported only with --trust"])
    _LOADED.add(package)
    for folder in map(str, folders()):
        if folder not in sys.path:
            sys.path.append(folder)
    try:
        return importlib.import_module(name)
    except RAISED as error:
        if isinstance(error, ModuleNotFoundError) and (lacking := errors.missing(error)):
            raise DocumentError([f"{label}, which cannot be imported: {lacking}"]) from error
        raise DocumentError([f"{label}, which cannot be imported ({reason_of(error)})"]) from error


def located(name: str, label: str) -> ModuleSpec:
    """Return the spec of a module without running it.

    Raises:
        DocumentError: the module does not exist; the text begins with `label`.
    """
    spec: ModuleSpec | None = None
    for part in accumulate(name.split("."), "{}.{}".format):
        where = spec.submodule_search_locations if spec else None
        if spec and where is None:
            raise DocumentError([f"{label}, and {spec.name} is not a package; {WHERE}"])
        if where is not None:
            spec = PathFinder.find_spec(part, list(where))
        else:
            specs = (finder.find_spec(part, None) for finder in sys.meta_path)
            spec = next(filter(None, specs), None) or PathFinder.find_spec(part, list(map(str, folders())))
        if spec is None:
            reason = f"ModuleNotFoundError: No module named {part!r}"
            raise DocumentError([f"{label}, which cannot be imported ({reason}); {WHERE}"])
    assert spec is not None  # every name has at least one part
    return spec


def _find(name: str, label: str, attribute: str) -> None:
    """Check, without running a module, that it exists and binds `attribute`; DocumentError if not."""
    spec = located(name, label)
    if not attribute or not (spec.origin or "").endswith(".py"):
        return
    try:
        tree = ast.parse(Path(spec.origin or "").read_bytes())
        bound = _bound(tree)
    except (OSError, SyntaxError, ValueError) as error:
        raise DocumentError([f"{label}, which cannot be imported ({reason_of(error)})"]) from error
    if attribute not in bound and "*" not in bound:
        own = sorted(bound - _imported_names(tree)) or ["it defines nothing"]
        raise DocumentError([f"{label}; must be one that {name} defines: {', '.join(own)}"])


def _bound(body: ast.AST) -> set[str]:
    """Return the names that a module's source binds, including in branches; `*` for a star import."""
    names: set[str] = set()
    for node in ast.iter_child_nodes(body):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)}
        else:
            names |= _bound(node)
    return names


def _imported_names(tree: ast.AST) -> set[str]:
    imports = (node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom))
    return {alias.asname or alias.name for node in imports for alias in node.names}


def _other_arguments(loaded: type, kind: type, method: str) -> tuple[str, str] | None:
    """Return the actual and expected parameters of a method that cannot be called like that of `kind`; else None."""
    expected, own = getattr_static(kind, method), getattr_static(loaded, method)
    if not (isfunction(expected) and isfunction(own)) or expected is own:
        return None  # a builtin or another kind of descriptor, whose arguments are unknown
    positional, required = Parameter.POSITIONAL_OR_KEYWORD, Parameter.empty
    parameters = signature(expected).parameters.items()
    names = [name for name, each in parameters if each.default is required and each.kind is positional]
    takes = signature(own)
    try:
        takes.bind(*names)
    except TypeError:
        return ", ".join(map(str, list(takes.parameters.values())[1:])), ", ".join(names[1:])
    return None
