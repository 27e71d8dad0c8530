r"""The texts of the control port, TCP 5559: the configuration, and the list of custom configurations.

The configuration is a line `section:key = value\n` for each entry, and a zero byte. The list has blocks `[applis]`,
`[profiles]`, `[sessions]`, with a line `id,description` for each, all ended by `\r`, and a zero byte.

Source: AR.Drone Developer Guide SDK 2.0, chapter 8; ARDroneLib, ardrone_control.c and
ardrone_control_configuration.c.
"""

from collections.abc import Mapping
from typing import NamedTuple

PORT = 5559  # TCP (ARDroneLib, config.h)
TEXT_MAX = 65_536  # bytes of a dump, chosen: the aircraft's has about 8000
END = b"\0"
_BLOCKS = ("applis", "profiles", "sessions")


class CustomList(NamedTuple):
    """Custom configurations that the aircraft keeps: descriptions by identifier."""

    applications: dict[str, str]
    profiles: dict[str, str]
    sessions: dict[str, str]


def format_configuration(entries: Mapping[str, str]) -> bytes:
    """Return the configuration as it goes on the wire."""
    return "".join(f"{key} = {value}\n" for key, value in entries.items()).encode("ascii", "replace") + END


def parse_configuration(data: bytes) -> dict[str, str]:
    """Return the entries of a configuration; lines that are none are left out."""
    text = data.split(END, 1)[0].decode("ascii", "replace")
    lines = (line.partition(" =") for line in text.splitlines())
    return {key.strip(): value.strip() for key, sign, value in lines if sign and ":" in key}


def format_custom_list(kept: CustomList) -> bytes:
    """Return the list of custom configurations as it goes on the wire."""
    parts: list[str] = []
    for block, entries in zip(_BLOCKS, kept, strict=True):
        parts += [f"[{block}]", *(f"{identifier},{text}" for identifier, text in entries.items())]
    return "".join(f"{part}\r" for part in parts).encode("ascii", "replace") + END


def parse_custom_list(data: bytes) -> CustomList:
    """Return the custom configurations of a list; lines that belong to no block are left out."""
    found: dict[str, dict[str, str]] = {block: {} for block in _BLOCKS}
    block: dict[str, str] | None = None
    for line in data.split(END, 1)[0].decode("ascii", "replace").replace("\n", "\r").split("\r"):
        if line.startswith("[") and line.endswith("]"):
            block = found.get(line[1:-1])
        elif block is not None and "," in line:
            identifier, _, text = line.partition(",")
            block[identifier] = text
    return CustomList(*found.values())
