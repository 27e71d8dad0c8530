"""ROS names of what has a name of the contract's, which allows more: `-`, `.`, and a digit at the beginning."""

import re
from collections.abc import Iterable

_OTHERS = re.compile(r"[^a-z0-9]+")  # and no two underscores in a row, which ROS reserves


def ros_name(name: str, what: str) -> str:
    """Return the nearest name that ROS takes: `quad-1.a` is `quad_1_a`, and a drone `7` is `drone_7`."""
    bare = _OTHERS.sub("_", name)
    return f"{what}_{bare}" if bare[0].isdigit() else bare


def ros_names(names: Iterable[str], what: str) -> dict[str, str]:
    """Return the ROS name of each; where two would have the same, the later ones get a number."""
    found: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        first = chosen = ros_name(name, what)
        number = 2
        while chosen in taken:
            chosen, number = f"{first.rstrip('_')}_{number}", number + 1
        taken.add(chosen)
        found[name] = chosen
    return found
