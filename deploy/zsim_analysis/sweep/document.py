"""A scenario's file with what the command line says of it, before anything varies."""

from pathlib import Path
from typing import Any

from zsim.errors import ScenarioError
from zsim.scenario import overrides as override
from zsim.scenario.scenario_file import EXAMPLE
from zsim.schema import plugin, yaml_file


def read(path: Path, overrides: list[str], **values: Any) -> tuple[dict[str, Any], list[str]]:
    """Return the raw document, as `scenario_file.load` takes it, and the faults of the overrides.

    Args:
        path: the file.
        overrides: texts `a.b.c=value` as given to `--set`, applied in order.
        values: top-level fields that replace the file's, None being ignored.

    Raises:
        ScenarioError: the file holds no map.
    """
    plugin.search(path.parent)
    document = yaml_file.read(path, EXAMPLE, ScenarioError)
    document.update({key: value for key, value in values.items() if value is not None})
    applied = [override.apply(document, text, yaml_file.value) for text in overrides]
    return document, [fault for fault in applied if fault]
