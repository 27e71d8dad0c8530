"""Which agents share a process: names and patterns of a command line against those that a scenario has."""

from collections.abc import Sequence
from fnmatch import fnmatchcase

from zsim.contract.messages import Info
from zsim.errors import RunError
from zsim.runtime.agent import Agent
from zsim.runtime.group import AgentGroup
from zsim.scenario.scenario import Scenario

NAMED_MAX = 10  # of the known names in a refusal


def chosen(what: str, patterns: Sequence[str], known: Sequence[str]) -> list[str]:
    """Return the known names that are named or that match a pattern such as `drone*`, in their own order.

    Raises:
        RunError: a pattern matches none; `what` says in the message what was looked for.
    """
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in known):
            how = "match" if any(sign in pattern for sign in "*?[") else "be"
            raise RunError(f"{what} is {pattern!r}; must {how} one of {_listed(known)}")
    return [name for name in known if any(fnmatchcase(name, pattern) for pattern in patterns)]


def _listed(names: Sequence[str]) -> str:
    more = [f"and {len(names) - NAMED_MAX} more"] if len(names) > NAMED_MAX else []
    return ", ".join([*names[:NAMED_MAX], *more]) or "none"


def agents_of(scenario: Scenario, patterns: Sequence[str] = ("*",)) -> list[str]:
    """Return the process names of the estimators and controllers that are meant, estimators first.

    Raises:
        RunError: a pattern matches none.
    """
    known = [f"estimator.{drone.name}" for drone in scenario.drones]
    known += [f"controller.{cluster.name}" for cluster in scenario.clusters]
    return chosen("host: process", patterns, known)


def hosted(info: Info, scenario: Scenario, patterns: Sequence[str]) -> Agent:
    """Return estimators and controllers as one agent.

    Raises:
        RunError: a pattern matches none, or the scenario cannot be flown.
    """
    from zsim_agents.estimation.estimator import Estimator
    from zsim_agents.formation.controller import Controller

    split = [name.partition(".") for name in agents_of(scenario, patterns)]
    drones = [thing for role, _, thing in split if role == "estimator"]
    clusters = [thing for role, _, thing in split if role == "controller"]
    members: list[Agent] = [Estimator(info, scenario, drones)] if drones else []
    return AgentGroup([*members, *(Controller(info, scenario, cluster) for cluster in clusters)])
