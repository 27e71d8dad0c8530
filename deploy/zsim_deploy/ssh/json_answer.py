"""What a program of ours says on a host as a JSON line, among what the login shell there may say. Pure."""

import json
from collections.abc import Iterable
from typing import Any


def answer(lines: Iterable[str]) -> dict[str, Any] | None:
    """Return the first JSON object among lines; None if there is none."""
    for line in lines:
        try:
            found = json.loads(line)
        except ValueError:
            continue
        if isinstance(found, dict):
            return found
    return None
