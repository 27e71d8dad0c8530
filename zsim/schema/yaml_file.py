"""YAML documents that people write: read with a limit, one line per fault, no aliases, no tags, YAML 1.2 floats."""

import re
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError
from yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent

from zsim.errors import DocumentError
from zsim.schema.checker import show

FILE_SIZE_MAX = 1_000_000  # bytes; a scenario of 1000 drones with every field given is below this
DEPTH_MAX = 50  # of what C code reads; a scenario has 6


def read(path: Path, example: str, refuse: type[DocumentError]) -> dict[str, Any]:
    """Return the map that a YAML file holds.

    Args:
        path: the file.
        example: a file of that kind, named to whoever gave another one.
        refuse: the error to raise, with a line for each fault.
    """
    try:
        with path.open("rb") as file:
            content = file.read(FILE_SIZE_MAX + 1)
        text = content.decode("utf-8-sig")
    except OSError as error:
        reason = error.strerror or str(error)
        raise refuse([f"{path}: cannot be read ({reason}); give the path of a YAML file"]) from error
    except UnicodeDecodeError as error:
        raise refuse([f"{path}: is not text (byte {error.start}); must be YAML in UTF-8"]) from error
    except ValueError as error:
        raise refuse([f"{show(str(path))}: is no path ({error}); give that of a YAML file"]) from error
    if len(content) > FILE_SIZE_MAX:
        raise refuse([f"{path}: is larger than {FILE_SIZE_MAX} bytes; must be at most that"])
    return parse(text, path.name, example, refuse)


def parse(text: str, source: str, example: str, refuse: type[DocumentError]) -> dict[str, Any]:
    """Return the map that a YAML text holds; `source` opens the lines of the faults."""
    try:
        document = value(text)
    except ValueError as error:
        raise refuse([f"{source}: {error}; see {example}"]) from error
    if not isinstance(document, dict):
        holds = f"holds {show(document)}" if text.strip() else "is empty"
        raise refuse([f"{source}: {holds}; must be a map as in {example}"])
    return document


def dump(plain: Any) -> str:
    """Return YAML text; the same content gives the same text."""
    return yaml.dump(plain, Dumper=_Dumper, sort_keys=True, default_flow_style=None, width=120)


def value(text: str) -> Any:
    """Return what a YAML text says; ValueError, a line long, if it says nothing."""
    if _FastLoader is not None:
        with suppress(yaml.YAMLError, ValueError, OverflowError):  # the other one says what is wrong
            if _is_plain(text):
                return yaml.load(text, Loader=_FastLoader)
    try:
        return yaml.load(text, Loader=_Loader)
    except RecursionError:
        raise ValueError("is nested too deep") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1} " if mark else ""
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ValueError(f"{where}is not YAML ({problem[:100]})") from error


_READ_OTHERWISE = re.compile("[\t\ufeff?]|[|>][-+0-9]*#")  # libyaml takes tabs, ? and |# where PyYAML does not


def _is_plain(text: str) -> bool:
    """Tell whether C code may read it: that knows no limit of its stack, and does not say where an alias stands."""
    if _READ_OTHERWISE.search(text):
        return False
    depth = 0
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        if depth > DEPTH_MAX or isinstance(event, AliasEvent) or getattr(event, "tag", None) is not None:
            return False
    return True


class _DistinctKeys:
    """Refuses keys that are given twice."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str) and key in seen:
                raise ConstructorError(None, None, f"key {show(key)} is given twice", key_node.start_mark)
            seen.add(key if isinstance(key, str) else None)
        return super().construct_mapping(node, deep)  # type: ignore[misc]


class _Loader(_DistinctKeys, yaml.SafeLoader):
    """YAML 1.2 floats (1e3 is a number); no aliases, for a bomb is made of them, and no tags."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if isinstance(event, AliasEvent):
            raise ComposerError(None, None, "aliases are not allowed", cast(Any, event.start_mark))
        if getattr(event, "tag", None) is not None:
            raise ComposerError(None, None, "tags are not allowed", event.start_mark)
        return super().compose_node(parent, index)


def _fast_loader() -> type[Any] | None:
    """Return a loader that means the same by what is plain, several times as fast; None where PyYAML has none."""
    if not yaml.__with_libyaml__:
        return None

    class Fast(_DistinctKeys, yaml.CSafeLoader):
        """libyaml's."""

    return Fast


_FastLoader = _fast_loader()


class _Dumper(yaml.SafeDumper):
    """Puts into quotes the texts that `_Loader` would read as numbers."""


for _yaml in filter(None, (_Loader, _FastLoader, _Dumper)):
    _yaml.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^[-+]?\.(inf|Inf)$|^\.(nan|NaN)$"),
        list("-+0123456789."),
    )
