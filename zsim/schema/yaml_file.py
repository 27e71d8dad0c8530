"""YAML documents that people write: read with a limit, one line per fault, no aliases, no tags, words of YAML 1.2."""

import re
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

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
    """Return the content of a YAML text; ValueError, a line long, if it is not YAML."""
    try:
        _check_events(text)
        return yaml.load(text, Loader=_Loader)
    except RecursionError:
        raise ValueError("is nested too deep") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {min(mark.line, text.count(chr(10))) + 1} " if mark else ""  # libyaml ends behind the last line
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ValueError(f"{where}is not YAML ({problem[:100]})") from error


def _check_events(text: str) -> None:
    """Refuse aliases, which can expand without end, tags, and a depth for which C code has no limit of its own."""
    depth = 0
    events: Iterable[Any] = yaml.parse(text, Loader=_Base)
    for event in events:
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        if depth > DEPTH_MAX:
            raise RecursionError
        if isinstance(event, AliasEvent):
            raise _refusal("aliases are not allowed", event)
        if getattr(event, "tag", None) is not None:
            raise _refusal("tags are not allowed", event)


def _refusal(problem: str, event: Any) -> ComposerError:
    return ComposerError(None, None, problem, event.start_mark)


_Base: Any = yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader  # libyaml: 3 to 5 times as fast


class _Loader(_Base):
    """Refuses keys that are given twice; takes words for what YAML 1.2 says (its core schema, section 10.3.2).

    So 1e3 and 010 are decimal numbers; 1:30, 1_000, yes, off, 2026-01-31 and the key << are text.
    """

    yaml_implicit_resolvers: ClassVar[dict[str | None, Any]] = {}

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str) and key in seen:
                raise ConstructorError(None, None, f"key {show(key)} is given twice", key_node.start_mark)
            seen.add(key if isinstance(key, str) else None)
        return super().construct_mapping(node, deep)

    def construct_whole(self, node: Any) -> int:
        """Return a whole number: decimal, 0o for octal, 0x for hexadecimal."""
        text = node.value
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)


class _Dumper(yaml.SafeDumper):
    """Puts into quotes the texts that `_Loader` would read as numbers."""


_TAG = "tag:yaml.org,2002:"
_FLOAT = r"^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"
_WORDS = (  # the first that fits counts
    ("null", r"^(~|null|Null|NULL|)$", [*"~nN", ""]),
    ("bool", r"^(true|True|TRUE|false|False|FALSE)$", [*"tTfF"]),
    ("int", r"^([-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$", [*"-+0123456789"]),
    ("float", _FLOAT, [*"-+0123456789."]),
)
for _yaml, (_kind, _pattern, _first) in product((_Loader, _Dumper), _WORDS):
    _yaml.add_implicit_resolver(f"{_TAG}{_kind}", re.compile(_pattern), _first)
_Loader.add_constructor(f"{_TAG}int", _Loader.construct_whole)
