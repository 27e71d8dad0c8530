"""YAML that people read: block style, fields in the order given, long texts as they stand, remarks on top."""

from collections.abc import Sequence
from typing import Any

import yaml


def document(plain: Any, remarks: Sequence[str] = ()) -> str:
    """Return one YAML document; the same content gives the same text."""
    head = "".join(f"# {line}\n" for line in remarks)
    return head + yaml.dump(plain, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=1000)


def documents(plain: Sequence[Any], remarks: Sequence[str] = ()) -> str:
    """Return several YAML documents in one text."""
    head = "".join(f"# {line}\n" for line in remarks)
    return head + "---\n".join(document(one) for one in plain)


class _Dumper(yaml.SafeDumper):
    """Keeps lines of a text as lines, and writes the same list twice rather than as an alias."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = "|" if "\n" in text else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _text)
