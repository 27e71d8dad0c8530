"""What a bundle needs of the machine on which it is made: users' modules, and the packages, with their versions.

Nothing of it is imported: modules are found as Python finds them, and what they import is read in their text. A name
that is put together while a program runs is not found there.
"""

import ast
import base64
import importlib.metadata
import json
import pickletools
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement

from zsim.errors import PACKAGES, DocumentError, RunError
from zsim.schema import plugin
from zsim_analysis.bundle.bundle_file import MODULES, PART

PROJECT = "zsim"
EXTRAS = ("agents", "record", "report", "world")  # what flies a bundle again, and draws its figures
BYTES_MAX = 50_000_000  # of all users' modules: code, not data
MODULE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")
PIN = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?==[A-Za-z0-9][A-Za-z0-9.!+_]*")  # a line of a lock


class OwnModules(NamedTuple):
    """Modules of users that are no installed packages, by their path in a bundle; and packages that they import."""

    files: dict[str, Path]
    packages: set[str]  # as they are imported, the first part of the name


def own_modules(names: Iterable[str]) -> OwnModules:
    """Return the modules of some classes, functions and modules of users, and of all that these import of the like.

    Args:
        names: as `Scenario.own_code` has them.

    Raises:
        DocumentError: one is nowhere.
        RunError: they are too large, or cannot be read.
    """
    found = OwnModules({}, set())
    wanted = [(name.partition(":")[0], True) for name in names]
    seen = set(PACKAGES) | set(sys.stdlib_module_names)
    while wanted:
        name, is_needed = wanted.pop()
        package = name.partition(".")[0]
        if package in seen:
            continue
        seen.add(package)
        try:
            spec = plugin.located(package, f"module {package}")
        except DocumentError:
            if is_needed:
                raise
            continue  # what is imported only where it is there
        places = [Path(spec.origin)] if spec.origin else [Path(each) for each in spec.submodule_search_locations or ()]
        if spec.origin in ("built-in", "frozen") or any(plugin.is_library(f"{place}") for place in places):
            found.packages.add(package)
            continue
        for path, inside in _sources(package, places):
            found.files[f"{MODULES}/{inside}"] = path
            if path.suffix == ".py":
                wanted += [(each, False) for each in _imports(path)]
    size = sum(path.stat().st_size for path in found.files.values())
    if size > BYTES_MAX:
        raise RunError(f"the scenario's own modules have {size} bytes; must have <= {BYTES_MAX}: keep data elsewhere")
    return found


def _sources(package: str, places: Iterable[Path]) -> Iterator[tuple[Path, str]]:
    """Yield the files of a module or a package, and their paths below the folder that holds it."""
    for place in places:
        if place.is_file() and place.name != "__init__.py":
            yield place, place.name
            continue
        folder = place if place.is_dir() else place.parent
        for path in sorted(folder.rglob("*")):
            inside = path.relative_to(folder)
            named = all(PART.fullmatch(part) for part in inside.parts)
            if named and "__pycache__" not in inside.parts and path.is_file():
                yield path, f"{package}/{inside.as_posix()}"


def _imports(path: Path) -> set[str]:
    """Return the modules that a module imports; of one made for a class of a notebook, what its pickle names."""
    try:
        tree = ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError) as error:
        raise RunError(f"{path}: cannot be read ({error})") from error
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    if path.name.startswith(plugin.MADE):
        texts = [
            node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]
        pickled = base64.b64decode(max(texts, key=len))
        named = {arg for _, arg, _ in pickletools.genops(pickled) if isinstance(arg, str)}
        names |= set(filter(MODULE.fullmatch, named))
    return names


# Packages


def locked(packages: Iterable[str] = ()) -> tuple[list[str], list[str]]:
    """Return what is installed here, as lines NAME==VERSION: all that flies, with what some packages need; and these.

    A package that came from elsewhere than an index has no such line.

    Args:
        packages: as they are imported.
    """
    by_import = importlib.metadata.packages_distributions()
    own = {_canonical(name) for each in packages for name in by_import.get(each, ())}
    pins: dict[str, str] = {}
    wanted = [(PROJECT, frozenset(EXTRAS)), *((name, frozenset[str]()) for name in sorted(own))]
    seen: set[tuple[str, frozenset[str]]] = set()
    while wanted:
        name, extras = wanted.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            installed = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        of_index = "+" not in installed.version and not json.loads(installed.read_text("direct_url.json") or "{}")
        if name != PROJECT and of_index:
            pins[name] = f"{name}=={installed.version}"
        for line in installed.requires or ():
            needed = Requirement(line)
            if needed.marker is None or any(needed.marker.evaluate({"extra": extra}) for extra in extras or ("",)):
                wanted.append((_canonical(needed.name), frozenset(needed.extras)))
    return sorted(pins.values()), sorted(pins[name] for name in own if name in pins)


def other_versions(lock: Iterable[str]) -> list[str]:
    """Return which packages of a lock are installed here in another version, or not at all."""
    differing = []
    for line in lock:
        name, _, version = line.partition("==")
        try:
            here = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            here = "none"
        if here != version:
            differing.append(f"{name} {version}, here {here}")
    return differing


def pins_of(text: str, where: str) -> list[str]:
    """Return the lines of a lock; RunError if one is anything but NAME==VERSION, such as an option or an address."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    for line in lines:
        if not PIN.fullmatch(line):
            raise RunError(f"{where}: has the line {line[:80]!r}; must be NAME==VERSION")
    return lines


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()  # PEP 503
