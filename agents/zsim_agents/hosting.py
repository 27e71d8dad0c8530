"""Creates the agents of a process from names and patterns, and checks the classes and plans of a scenario."""

import json
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial
from inspect import signature
from types import FunctionType
from typing import Any, NamedTuple

from msgspec import UNSET
from msgspec.structs import replace

from zsim.contract import keys
from zsim.contract.messages import Info, register_messages
from zsim.errors import DocumentError, NotTrustedError, RunError, ScenarioError
from zsim.runtime.agent import Agent, AgentGroup, default_name
from zsim.runtime.inbox import output_hold_ns
from zsim.scenario.own_classes import messages_of
from zsim.scenario.roles import AGENTS, agent_names, agent_roles, expected_processes
from zsim.scenario.scenario import OwnAgent, Scenario
from zsim.scenario.scenario_file import to_text
from zsim.schema import parameters, plugin, yaml_file
from zsim.schema.checker import show

NAMED_MAX = 10  # maximum number of known names in a refusal


def chosen(what: str, patterns: Sequence[str], known: Sequence[str]) -> list[str]:
    """Return the known names that are listed or match a pattern such as `drone*`, in the order of `known`.

    Raises:
        RunError: a pattern matches no name; `what` names the kind of name in the text.
    """
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in known):
            verb = "match" if any(sign in pattern for sign in "*?[") else "be"
            rest = [f"and {len(known) - NAMED_MAX} more"] if len(known) > NAMED_MAX else []
            listed = ", ".join([*known[:NAMED_MAX], *rest]) or "none"
            raise RunError(f"{what} is {pattern!r}; must {verb} one of {listed}")
    return [name for name in known if any(fnmatchcase(name, pattern) for pattern in patterns)]


def agents_of(scenario: Scenario, patterns: Sequence[str] = ("*",)) -> list[str]:
    """Return the process names of the agents that match, by role, estimators first; RunError: no match."""
    return chosen("host: process", patterns, agent_names(scenario))


def check_classes(scenario: Scenario, source: str, elsewhere: bool = False) -> None:
    """Check that the classes named in a scenario can be loaded here.

    Args:
        source: name of the scenario's file, with which each fault begins.
        elsewhere: whether controllers and users' agents run on other hosts; only there are their classes needed.

    Raises:
        ScenarioError: names are wrong or their classes cannot be loaded; one fault per line.
    """
    from zsim_agents.estimation.drone_estimator import estimator_class

    loads: list[Callable[[], Any]] = [
        partial(estimator_class, scenario.estimation.chosen(), f"{source}: estimation.algorithm")
    ]
    metrics = scenario.report.metric_names
    loads += [partial(plugin.load_function, each, f"{source}: report.metrics") for each in metrics]
    if not elsewhere:
        own = scenario.own_agents.items()
        loads += [partial(_check_agent, each, f"{source}: agents.{role}", scenario) for role, each in own]
    for cluster in () if elsewhere else scenario.clusters:
        where = f"{source}: cluster {cluster.name!r}"
        for part, space in [(where, cluster.space), *((f"{where}, group {g.name!r}", g.space) for g in cluster.groups)]:
            if space and ":" in space:
                from zsim_agents.formation.spaces.cluster_space import ClusterSpace

                loads.append(partial(plugin.load, space, f"{part}: space", ClusterSpace))
        if cluster.law and ":" in cluster.law:
            from zsim_agents.formation.control_law import ControlLaw

            loads.append(partial(plugin.load, cluster.law, f"{where}: law", ControlLaw))
    faults = []
    for load in loads:
        try:
            load()
        except NotTrustedError:
            continue  # the class exists
        except DocumentError as error:
            faults += error.faults
    if faults:
        raise ScenarioError(faults)


def _check_agent(own: OwnAgent, where: str, scenario: Scenario) -> None:
    """Check that the class of an agent can be loaded, and check its parameters with its method `flaws`, if any."""
    kind: Any = plugin.load(own.named, f"{where}.class", Agent)
    flaws = getattr(kind, "flaws", None)
    if flaws and (found := [f"{where}.parameters.{path} {text}" for path, text in flaws(own.parameters, scenario)]):
        raise DocumentError(found)


def check_plans(scenario: Scenario, source: str) -> None:
    """Check the plans of a scenario as its controllers and pilots do: expressions, names, templates, references.

    In a run of several processes, controllers and pilots check the plans themselves: they load the modules anyway.

    Raises:
        ScenarioError: a plan cannot be flown; one fault per line.
    """
    from zsim_agents.formation.engagement_setup import check_plan

    faults = []
    if scenario.piloted():
        from zsim_agents.references.flight import flight_faults

        faults += [f"{source}: {path} {text}" for path, text in flight_faults(scenario)]
    for cluster in scenario.clusters:
        try:
            check_plan(scenario, cluster)
        except NotTrustedError:
            continue  # only the class of its space knows which variables a plan may name
        except RunError as error:
            faults.append(f"{source}: {error}")
    if faults:
        raise ScenarioError(faults)


def hosted(info: Info, scenario: Scenario, patterns: Sequence[str]) -> Agent:
    """Return the matching agents of all roles as one; RunError: none match, or the scenario cannot be flown."""
    split = [name.partition(".") for name in agents_of(scenario, patterns)]
    by_role = {role: [member for each, _, member in split if each == role] for role in agent_roles(scenario)}
    members = [agent for role, names in by_role.items() if names for agent in make_agents(role, info, scenario, names)]
    return members[0] if len(members) == 1 else AgentGroup(members, output_hold_ns(info))


def make_agents(role: str, info: Info, scenario: Scenario, names: Sequence[str]) -> list[Agent]:
    """Create the agents of one role for drones or clusters, or a joint agent for roles that have one."""
    if own := scenario.own_agents.get(role):
        kind = plugin.load_any(own.named, f"agents.{role}.class", Agent)
        if own.map is False:
            info, scenario = without_map(info, scenario)
        return [own_agent(kind, info, scenario, own.parameters, f"{role}.{name}", own.per) for name in names]
    agent = agent_class(role)
    try:
        if AGENTS[role].joint:
            return [agent(info, scenario, names)]
        return [agent(info, scenario, name) for name in names]
    except plugin.RAISED as error:
        failure = plugin.user_code_error(error, f"{role} of {', '.join(names)}, before the start")
        if failure is None:
            raise
        raise failure from error


class AgentSpec(NamedTuple):
    """A user's agent on a command line: `[NAME=]MODULE:CLASS [SETTING=VALUE]...`."""

    named: str  # the class, a function that returns the agent, or the agent
    settings: dict[str, Any]  # arguments of the class
    name: str  # name of its process

    @classmethod
    def parse(cls, arguments: Sequence[str], name: str = "") -> "AgentSpec":
        """Return the agent that the arguments describe, after loading its class in this process.

        Raises:
            RunError: a setting or a name is malformed.
            DocumentError: the class does not exist.
        """
        given, _, named = arguments[0].rpartition("=")
        settings: dict[str, Any] = {}
        for argument in arguments[1:]:
            setting, equals, value = argument.partition("=")
            if not (equals and setting.isidentifier()):
                raise RunError(f"setting of {named} is {argument!r}; must be NAME=VALUE")
            try:
                settings[setting] = yaml_file.value(value)
            except ValueError as error:
                raise RunError(f"setting {setting} of {named} {error}; must be a value in YAML") from error
        source = plugin.load_any(named, "agent", Agent)
        return cls(named, settings, keys.name(name or given or process_name(source)))

    def arguments(self) -> list[str]:
        """Return the arguments from which `parse` creates this spec."""
        named = f"{self.name}={self.named}"
        return [named, *(f"{setting}={json.dumps(value)}" for setting, value in self.settings.items())]

    def make(self, info: Info, scenario: Scenario) -> Agent:
        """Return the agent, ready to join; errors as for `own_agent`."""
        return own_agent(plugin.load_any(self.named, "agent", Agent), info, scenario, self.settings, self.name)


def process_name(source: Agent | Callable[..., Agent]) -> str:
    """Return the process name of a user's agent, or of the one that a class or function will create."""
    name = getattr(source, "name", None)
    return name if isinstance(name, str) else default_name(type(source) if isinstance(source, Agent) else source)


def without_map(info: Info, scenario: Scenario) -> tuple[Info, Scenario]:
    """Return info and scenario without obstacles and surfaces, for an agent without access to the map."""
    bare = replace(scenario, environment=replace(scenario.environment, obstacles=[], surfaces=UNSET))
    return replace(info, scenario=to_text(bare)), bare


def with_own_agents(scenario: Scenario, names: Sequence[str]) -> Scenario:
    """Return a resolved scenario whose run waits for users' agents, and ends if one of them dies.

    The scenario's entries for these agents in `processes.on_death` take precedence.
    """
    processes = scenario.processes
    expect = [*dict.fromkeys((*expected_processes(scenario), *names))]
    ends = {name: "end" for name in names if name.partition(".")[0] not in processes.on_death}
    return replace(scenario, processes=replace(processes, expect=expect, on_death={**ends, **processes.on_death}))


def own_agent(
    source: Agent | Callable[..., Agent],
    info: Info,
    scenario: Scenario,
    settings: Mapping[str, Any] = {},
    name: str = "",
    per: str = "run",
) -> Agent:
    """Return a user's agent, ready to join.

    Args:
        source: the agent; or a class or function that creates it from `settings`, its parameters, and from `info`,
            `scenario` and the name of its `drone` or `cluster`, if it takes arguments of these names.
        name: name of its process; empty for the agent's own name.
        per: "drone" or "cluster" for an agent of a single one, "run" for others.

    Raises:
        UserCodeError: the class or function raised an error.
        RunError: the settings do not fit the arguments of the class or function, or it does not return an agent.
        DocumentError: the agent's parameters or messages are not allowed.
    """
    if not isinstance(source, Agent):
        if not callable(source):
            raise RunError(f"agent is {show(source)}; must be a zsim.Agent, or a class or a function that makes one")
        kind = f"{source.__module__}:{source.__qualname__}" if isinstance(source, type | FunctionType) else show(source)
        try:
            accepted = signature(source)
        except ValueError as error:  # a partial whose arguments the class does not take
            raise RunError(f"{kind} cannot be called: {error}") from None
        given = {"info": info, "scenario": scenario, per: name.partition(".")[2]}
        given = {key: value for key, value in given.items() if key in accepted.parameters}
        make: Callable[..., Agent] = source
        if parameters.has_parameters(source):
            make = parameters.bound(source, dict(settings), kind)
        else:
            given |= settings
        try:
            accepted.bind(**given)
        except TypeError as error:
            raise RunError(f"{kind} takes {accepted}, and cannot be called with these settings: {error}") from None
        try:
            source = make(**given)
        except plugin.RAISED as error:
            failure = plugin.user_code_error(error, "before the start")
            if failure is None:
                raise
            raise failure from error
        if not isinstance(source, Agent):
            raise RunError(f"{kind} makes a {type(source).__name__}; must make a zsim.Agent")
    register_messages(messages_of(type(source), plugin.full_name(type(source))))
    source.bind(info, name, scenario.radio_of_agents)
    return source


def agent_class(role: str) -> Callable[..., Agent]:
    """Return the class of a role's agents; its module is imported only now, as hosts of other roles do not need it."""
    return plugin.load(AGENTS[role].agent, role, Agent)
