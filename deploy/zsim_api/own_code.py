"""Names `module:Name` for what a notebook or a script defines, so that a scenario can name it as any other class.

What other processes cannot import gets a module of its own, a file `zsim_own_HASH.py`: the source, to be read, and the
object as cloudpickle has pickled it by value, which is what the module makes. In this process the module holds the very
object. The same class, defined again in the same way, gets the same name, here and in later processes.
"""

import base64
import hashlib
import importlib
import inspect
import io
import linecache
import pickletools
import re
import sys
import textwrap
from ast import ClassDef, parse, walk
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.machinery import ModuleSpec
from itertools import accumulate
from pathlib import Path
from types import CodeType, FunctionType, GetSetDescriptorType, MemberDescriptorType, ModuleType
from typing import Any

import cloudpickle
import cloudpickle.cloudpickle as cloudpickle_parts

from zsim import __version__
from zsim.errors import PACKAGES, RunError, reason_of
from zsim.schema import plugin

PICKLED = "PICKLED"  # what holds the pickle in a module
NAME = re.compile(r"[^\W\d]\w*")
DEPTH_MAX = 8  # of parts in parts that are searched for what cannot be pickled
_PYTHON = sys.version_info[:2]


def name_of(obj: object, folder: Path, name: str | None = None) -> str:
    """Return the name `module:Name` under which this process, and others, find a class, a function or an instance.

    It is that of the object's own module if other processes can import it from there. Otherwise a module
    `zsim_own_HASH.py` is written into the folder, which is to be searched for modules (`plugin.search`), together with
    those of `module_folders`.

    Args:
        folder: made if it is not there.
        name: the one to be given to it in that module; None: its own, that of its class for an instance.

    Raises:
        RunError: it cannot be pickled, or the file cannot be written; one line that names the class and its attribute.
    """
    kind: Any = obj if hasattr(obj, "__qualname__") else type(obj)  # a class, a function; or the class of an instance
    if kind is obj and name in (None, kind.__qualname__) and _is_found(kind):
        return f"{kind.__module__}:{kind.__qualname__}"
    given = name or str(kind.__name__ if NAME.fullmatch(kind.__name__) else "function")
    return f"{_written(obj, kind, given, folder)}:{given}"


def _written(obj: object, kind: Any, name: str, folder: Path) -> str:
    """Write the module of an object, kept here under its name; return the module's."""
    pickled, files = _pickled(obj, kind)
    source = _source(kind)
    made = f"{name} = pickle.loads(base64.b64decode({PICKLED}))\n"
    digest = hashlib.sha256(f"{_PYTHON}{source}{made}{''.join(_tokens(pickled, files))}".encode())
    module = ModuleType(f"{plugin.MADE}{digest.hexdigest()[:12]}")
    head = HEAD.format(title=f"{module.__name__}:{name}", of=_shown(kind), version=__version__, python=_PYTHON)
    readable = "".join(f"# {line}".rstrip() + "\n" for line in source.splitlines())
    lines = base64.encodebytes(pickled).decode()
    path = folder / f"{module.__name__}.py"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text(f'{head}\n{readable}\n{PICKLED} = """\n{lines}"""\n{made}', encoding="utf-8")
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror})") from error
    setattr(module, PICKLED, lines)
    setattr(module, name, obj)
    sys.modules[module.__name__] = module
    importlib.invalidate_caches()  # the file is newer than what Python knows of the folder
    return module.__name__


HEAD = '''"""{title}: {of}, which was defined in a notebook or a script.

Made by zsim {version}. The comment shows the source; what this module makes is the object in the pickle.
"""

import base64
import pickle
import sys

if sys.version_info[:2] != {python}:
    raise ImportError("was pickled by Python {python[0]}.{python[1]}, whose bytecode no other version runs")
'''


def module_folders(names: Iterable[str]) -> list[Path]:
    """Return the folders of a script's own modules that others need, too, to import what `name_of` has named.

    They are those of `sys.path` that hold modules beside the script or notebook; not those of installed packages.
    """
    needed: dict[str, None] = {}
    for name in (each.partition(":")[0] for each in names):
        lines = getattr(sys.modules.get(name), PICKLED, None)
        if not (name.startswith(plugin.MADE) and lines):
            needed[name] = None
        else:
            pickled = base64.b64decode(lines)
            needed.update((arg, None) for _, arg, _ in pickletools.genops(pickled) if isinstance(arg, str))
    modules = [sys.modules[name] for name in needed if name in sys.modules and name != "__main__"]
    folders: dict[Path, None] = {}
    for module in modules:
        path, package = getattr(module, "__file__", None) or "", module.__name__.partition(".")[0]
        if path and package not in PACKAGES and not plugin.is_library(path):
            steps = module.__name__.count(".") + (Path(path).name == "__init__.py")
            folders[Path(path).resolve().parents[steps]] = None
    return list(folders)


def _is_found(own: Any) -> bool:
    """Tell whether others, too, get this very object by its own module and name."""
    module = sys.modules.get(own.__module__ or "")
    if module is None or module.__name__ == "__main__" or getattr(module, own.__qualname__, None) is not own:
        return False
    return _is_importable(module)


def _is_importable(module: ModuleType) -> bool:
    """Tell whether Python finds the file of a module by its name; not that of a module that was made otherwise."""
    found: ModuleSpec | None = None
    try:
        for part in accumulate(module.__name__.split("."), "{}.{}".format):
            place = found.submodule_search_locations if found else None
            found = next(filter(None, (finder.find_spec(part, place) for finder in sys.meta_path)), None)
    except (ImportError, AttributeError, ValueError):
        return False
    return found is not None and (not found.has_location or found.origin == module.__file__)


def _pickled(obj: object, kind: Any) -> tuple[bytes, set[str]]:
    """Pickle an object by value, with what it uses of its own module; return the files of its code, too.

    Raises:
        RunError: it cannot be pickled.
    """
    with _by_value(kind):
        try:
            file = io.BytesIO()
            pickler = _Pickler(file)
            pickler.dump(obj)
            return file.getvalue(), pickler.files
        except Exception as error:  # of any type: the objects to be pickled raise it
            part = " of ".join([*reversed(_unpicklable(obj)), _shown(kind)])
            must = "make it in the method that first needs it"
            raise RunError(f"{part} cannot be pickled ({reason_of(error)}); {must}") from error


@contextmanager
def _by_value(kind: Any) -> Iterator[None]:
    """Pickle by value what is of the same module, if others cannot import that."""
    module = sys.modules.get(kind.__module__ or "")
    wanted = module is not None and module.__name__ != "__main__" and not _is_importable(module)
    if wanted:
        cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        if wanted:
            cloudpickle.unregister_pickle_by_value(module)


class _Pickler(cloudpickle.Pickler):
    """Keeps the file, or cell, that code is from, for tracebacks: `files`."""

    def __init__(self, file: io.BytesIO) -> None:
        self.files: set[str] = set()
        self.dispatch_table: dict[type, Any] = {**cloudpickle.Pickler.dispatch_table, CodeType: self._code}
        super().__init__(file)

    def _code(self, code: CodeType) -> tuple[Any, ...]:
        self.files.add(code.co_filename)
        path = "".join(code.co_filename)  # a string of its own, as cloudpickle makes them: memoized strings vary
        made, arguments, *rest = cloudpickle.Pickler.dispatch_table[CodeType](code)
        return made, tuple(path if each == "<dynamic-code>" else each for each in arguments), *rest


def _tokens(pickled: bytes, files: set[str]) -> Iterator[str]:
    """Yield what a pickle says, equal for equal objects: without files, and the numbers that are drawn in a process."""
    drawn: dict[str, str] = {}
    for opcode, arg, _ in pickletools.genops(pickled):
        if not isinstance(arg, str):  # a frame's is a number of bytes; that of an array's content a bytearray
            yield "" if opcode.name == "FRAME" else f"{arg!r}\n"
        elif arg in cloudpickle_parts._DYNAMIC_CLASS_TRACKER_BY_ID:
            yield drawn.setdefault(arg, f"class {len(drawn)}\n")
        elif arg not in files:
            yield f"{arg!r}\n"


def _source(kind: Any) -> str:
    """Return the source of a class or function, empty if it is not known."""
    functions = [each for each in (kind, *getattr(kind, "__dict__", {}).values()) if isinstance(each, FunctionType)]
    for path in dict.fromkeys(each.__code__.co_filename for each in functions):  # a cell has no file
        lines = linecache.getlines(path)
        with suppress(SyntaxError):
            for node in walk(parse("".join(lines))):
                if isinstance(node, ClassDef) and node.name == kind.__name__:
                    first = min(each.lineno for each in (node, *node.decorator_list)) - 1
                    return textwrap.dedent("".join(lines[first : node.end_lineno])).strip()
    with suppress(OSError, TypeError):
        return textwrap.dedent(inspect.getsource(kind)).strip()
    return ""


def _unpicklable(obj: Any, depth: int = 0) -> list[str]:
    """Return the names that lead to what cannot be pickled: attributes, and names that methods use."""
    if isinstance(obj, FunctionType):
        used = inspect.getclosurevars(obj)
        parts = {**used.globals, **used.nonlocals}
    else:
        parts = {name: each for name, each in getattr(obj, "__dict__", {}).items() if not isinstance(each, _OF_PYTHON)}
        if not isinstance(obj, type | ModuleType):
            parts[type(obj).__name__] = type(obj)
    for name, part in parts.items():
        part = getattr(part, "__func__", part)  # of a static or class method
        try:
            cloudpickle.dumps(part)
        except Exception:  # as above
            return [name, *(_unpicklable(part, depth + 1) if depth < DEPTH_MAX else ())]
    return []


_OF_PYTHON = (GetSetDescriptorType, MemberDescriptorType)  # among the attributes of a class; never pickled


def _shown(kind: Any) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"
