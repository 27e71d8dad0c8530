"""What the death of a process means for a run, for its world and its launcher alike."""

from collections.abc import Mapping

from zsim.scenario.scenario import OnDeath

DEFAULTS: dict[str, OnDeath] = {
    "world": "end",
    "recorder": "end",
    "estimator": "restart",
    "controller": "restart",
    "router": "restart",
}


def on_death(given: Mapping[str, OnDeath], name: str, role: str | None = None) -> OnDeath:
    """Return what is to be done when a process dies: what is said of it, else of its role, else the default.

    Args:
        given: of the scenario, by process name or role.
        name: of the process.
        role: that it says it has; else what its name begins with.
    """
    role = role or name.partition(".")[0]
    return given.get(name) or given.get(role) or DEFAULTS.get(role, "drop")
