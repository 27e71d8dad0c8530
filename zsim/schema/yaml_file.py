"""Handwritten YAML documents, read with limits: no aliases, no tags, scalars as in YAML 1.2, one line per fault."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml
from yaml import events
from yaml.error import MarkedYAMLError

from zsim.errors import DocumentError
from zsim.schema.checker import show

FILE_SIZE_MAX = 4_000_000  # bytes; a resolved scenario of 1000 drones has 2.2 MB
VALUES_MAX = 400_000  # keys and values of a document; a resolved scenario of 1000 drones has 280 000, read in 1 s
DEPTH_MAX = 50  # nesting depth of maps and lists; a scenario has 6


def read(path: Path, example: str, refuse: type[DocumentError]) -> dict[str, Any]:
    """Return the map that a YAML file contains.

    Args:
        example: an example of such a file, named in errors.
        refuse: class of the error to raise, with a line for each fault.
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
        raise refuse([f"{show(str(path))}: is not a path ({error}); give that of a YAML file"]) from error
    if len(content) > FILE_SIZE_MAX:
        raise refuse([f"{path}: is larger than {FILE_SIZE_MAX} bytes; must be at most that"])
    return parse(text, path.name, example, refuse)


def parse(text: str, source: str, example: str, refuse: type[DocumentError]) -> dict[str, Any]:
    """Return the map that a YAML text contains; errors begin with `source`."""
    try:
        document = value(text)
    except ValueError as error:
        raise refuse([f"{source}: {error}; see {example}"]) from error
    if not isinstance(document, dict):
        holds = f"contains {show(document)}" if text.strip() else "is empty"
        raise refuse([f"{source}: {holds}; must be a map as in {example}"])
    return document


def dump(plain: Any) -> str:
    return yaml.dump(plain, Dumper=_Dumper, sort_keys=True, default_flow_style=None, width=120)


def value(text: str) -> Any:
    """Return the content of a YAML text; ValueError with one line of text if it is not YAML."""
    try:
        return _Reader(text).document()
    except RecursionError:
        raise ValueError("is nested too deeply") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {min(mark.line, text.count(chr(10))) + 1} " if mark else ""  # libyaml may count one too many
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        if "nesting depth" in problem:  # PyYAML has its own limit since 6.0.4
            raise ValueError("is nested too deeply") from None
        raise ValueError(f"{where}is not YAML ({problem[:100]})") from error


_Base: Any = yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader  # libyaml: 3 to 5 times as fast


class _Reader:
    """Builds values from YAML events, stopping at the first that is refused.

    It refuses aliases (which can expand without limit), tags, directives, duplicate keys, and excessive depths or
    numbers of values (which the C library does not limit). Plain scalars follow the core schema of YAML 1.2 (section
    10.3.2): 1e3 and 010 are decimal numbers; 1:30, 1_000, yes, off, 2026-01-31 and the key << are text.
    """

    def __init__(self, text: str) -> None:
        if _DIRECTIVE.search(text):  # libyaml compares each of them with all previous ones
            raise ValueError("directives are not allowed")
        self._events: Iterator[Any] = yaml.parse(text, Loader=_Base)
        self._count = 0

    def document(self) -> Any:
        """Return the content of the only document; None for an empty text."""
        content, event = None, self._after(events.StreamStartEvent)
        if isinstance(event, events.DocumentStartEvent):
            content = self._node(next(self._events), 0)
            event = self._after(events.DocumentEndEvent)
        if not isinstance(event, events.StreamEndEvent):
            raise _refusal("a second document is not allowed", event)
        return content

    def _after(self, kind: type[Any]) -> Any:
        event = next(self._events)
        assert isinstance(event, kind), event
        return next(self._events)

    def _node(self, event: Any, depth: int) -> Any:
        self._count += 1
        if isinstance(event, events.AliasEvent):
            raise _refusal("aliases are not allowed", event)
        if event.tag is not None:
            raise _refusal("tags are not allowed", event)
        if self._count > VALUES_MAX:
            raise _refusal(f"there are more than {VALUES_MAX} keys and values", event)
        if isinstance(event, events.ScalarEvent):
            return _plain_scalar(event.value) if event.implicit[0] else event.value
        if depth == DEPTH_MAX:
            raise RecursionError
        return self._list(depth + 1) if isinstance(event, events.SequenceStartEvent) else self._map(depth + 1)

    def _list(self, depth: int) -> list[Any]:
        items: list[Any] = []
        while not isinstance(event := next(self._events), events.SequenceEndEvent):
            items.append(self._node(event, depth))
        return items

    def _map(self, depth: int) -> dict[Any, Any]:
        content: dict[Any, Any] = {}
        written: set[str] = set()
        while not isinstance(event := next(self._events), events.MappingEndEvent):
            key = self._node(event, depth)
            if isinstance(key, list | dict):
                raise _refusal(f"a key is {show(key)}; must be text or a number", event)
            if event.value in written:
                raise _refusal(f"key {show(event.value)} is given twice", event)
            written.add(event.value)
            content[key] = self._node(next(self._events), depth)
        return content


def _refusal(problem: str, event: Any) -> MarkedYAMLError:
    return MarkedYAMLError(None, None, problem, event.start_mark)


def _plain_scalar(text: str) -> Any:
    for _, pattern, first, meaning in _WORDS:
        if text[:1] in first and pattern.match(text):
            return meaning(text)
    return text


def _whole(text: str) -> int:
    return int(text, 0) if text[:2] in ("0o", "0x") else int(text)


def _real(text: str) -> float:
    """Return a number; YAML writes Python's inf and nan as .inf and .nan."""
    return float(text.replace(".", "", 1) if text[-1] in "fFnN" else text)


class _Dumper(yaml.SafeDumper):
    """Quotes strings that `_plain_scalar` would read as another type."""


_DIRECTIVE = re.compile(r"^\ufeff?%", re.MULTILINE)
_FLOAT = r"^[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"
# tag, pattern, possible first characters, and conversion of each kind of scalar; the first match applies
_WORDS: tuple[tuple[str, re.Pattern[str], list[str], Callable[[str], Any]], ...] = (
    ("null", re.compile(r"^(~|null|Null|NULL|)$"), [*"~nN", ""], lambda text: None),
    ("bool", re.compile(r"^(true|True|TRUE|false|False|FALSE)$"), [*"tTfF"], lambda text: text.lower() == "true"),
    ("int", re.compile(r"^([-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$"), [*"-+0123456789"], _whole),
    ("float", re.compile(_FLOAT), [*"-+0123456789."], _real),
)
for _kind, _pattern, _first, _ in _WORDS:
    _Dumper.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", _pattern, _first)
