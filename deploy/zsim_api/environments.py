"""Environments for reinforcement learning in any scenario: PettingZoo's ParallelEnv, Gymnasium's Env and VectorEnv.

    env = zsim.parallel_env("step.yaml", reward=near_start, terminated=zsim.flipped, observe="estimate", step_s=0.1)
    observations, infos = env.reset(seed=3)

An episode begins when all drones are in the air; it ends with the scenario's duration, unless it is terminated earlier.
The effect of an action becomes visible after the command's delay (`infos[agent]["command_delay_s"]`), as everywhere in
zsim: see docs/python.md.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import signature
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from zsim.errors import RunError
from zsim.scenario.roles import agent_names
from zsim_api.policy import OBSERVATION_MAX, Action, Floats, Interface, Observe
from zsim_api.scenarios import AnyScenario, Scenario, scenario_of
from zsim_api.simulation import Simulation

Reward = Callable[[Simulation, str], float]  # reward of an agent after a step
Ended = Callable[[Simulation, str], bool]
Randomise = Callable[[np.random.Generator], Mapping[str, Any]]  # returns fields of an episode's scenario by path
SEEDS = 2**31


def never(sim: Simulation, agent: str) -> bool:
    """Terminate no episode before the scenario's end."""
    return False


def collided(sim: Simulation, agent: str) -> bool:
    """End the episode of a drone that hits a drone, an obstacle or the ground, or of a cluster with such a drone."""
    drones = _drones(sim, agent)
    collisions = (event for event in sim.events if event.kind in ("collision", "impact"))
    return any(event.subject in drones or event.data.get("other") in drones for event in collisions)


def flipped(sim: Simulation, agent: str) -> bool:
    """End the episode of a drone whose z axis points below the horizon, or of a cluster with such a drone."""
    _, x, y, _ = sim.truth.orientation_wxyz[[sim.names.index(drone) for drone in _drones(sim, agent)]].T
    return bool((1 - 2 * (x * x + y * y) < 0).any())


def far_away(distance_m: float) -> Ended:
    """Return a condition that ends an agent's episode once a drone is more than `distance_m` from its start."""

    def is_far(sim: Simulation, agent: str) -> bool:
        indices = [sim.names.index(drone) for drone in _drones(sim, agent)]
        starts = np.array([sim.scenario.drones[i].position_m for i in indices])
        return bool((np.linalg.norm(sim.truth.position_m[indices] - starts, axis=1) > distance_m).any())

    return is_far


def any_of(*conditions: Ended) -> Ended:
    """Return a condition that holds if any of `conditions` holds."""
    return lambda sim, agent: any(each(sim, agent) for each in conditions)


def _drones(sim: Simulation, agent: str) -> Sequence[str]:
    of_cluster = next((cluster.drones for cluster in sim.scenario.clusters if cluster.name == agent), None)
    return of_cluster if of_cluster is not None and agent not in sim.names else (agent,)


class _Episodes:
    """Episodes of a scenario, shared by all kinds of environments; arguments as in `parallel_env`."""

    def __init__(
        self,
        scenario: AnyScenario,
        *,
        reward: Reward,
        terminated: Ended = never,
        randomise: Randomise | None = None,
        observe: Observe = "truth",
        action: Action = "velocity",
        step_s: float | None = None,
        duration_s: float | None = None,
        set: Mapping[str, Any] | None = None,
    ) -> None:
        source = scenario_of(scenario).changed(duration_s=duration_s, set=set)
        self.interface = Interface(source.resolved, observe, action, step_s)
        estimators = [name for name in agent_names(source.resolved) if name.startswith("estimator.")]
        expect = estimators if observe == "estimate" else []
        self.scenario: Scenario = source.with_({"processes.expect": expect})
        self._reward, self._terminated, self._randomise = reward, terminated, randomise
        self.sim = Simulation(self.scenario)
        self.action_spaces: dict[str, Box] = {}
        self.observation_spaces: dict[str, Box] = {}
        for agent in self.interface.agents:
            size, action_size = self.interface.size(agent), len(self.interface.bounds(agent)[0])
            self.action_spaces[agent] = Box(-1.0, 1.0, (action_size,), np.float32)
            self.observation_spaces[agent] = Box(-OBSERVATION_MAX, OBSERVATION_MAX, (size,), np.float32)

    def begin(self, rng: np.random.Generator) -> dict[str, Floats]:
        """Start an episode by flying until all drones are in the air; return the observations.

        Raises:
            RunError: the scenario ends before all drones are in the air.
        """
        values = self._randomise(rng) if self._randomise else {}
        self.sim.source = self.scenario.changed(seed=int(rng.integers(SEEDS)), set=values)
        self.sim.reset()
        while (commands := self.interface.begin(self.sim)) is not None:
            if self.sim.ended is not None:
                states = ", ".join(f"{name} {self.sim.state(name)}" for name in self.sim.names)
                raise RunError(f"{self.scenario.source}: ended before all drones were in the air: {states}")
            self._fly(commands)
        return self.interface.observations(self.sim)

    def step(self, actions: Mapping[str, Any]) -> dict[str, Floats]:
        """Fly to the time of the next action; return the observations."""
        self._fly(self.interface.commands(self.sim, actions))
        return self.interface.observations(self.sim)

    def _fly(self, commands: Mapping[str, Any]) -> None:
        events = []
        for gate in range(self.interface.gates):
            if self.sim.ended is not None:
                break
            self.sim.step(commands if gate == 0 else {})
            events += self.sim.events
        self.sim.events = events

    def reward(self, agent: str) -> float:
        return float(self._reward(self.sim, agent))

    def terminated(self, agent: str) -> bool:
        return bool(self._terminated(self.sim, agent))

    def info(self) -> dict[str, Any]:
        return {"t_s": self.sim.t_s, "command_delay_s": self.sim.command_delay_s}


class FormationEnv(ParallelEnv[str, Floats, Floats]):
    """PettingZoo environment for a scenario, with one agent per drone or per cluster; see `parallel_env`."""

    metadata = {"name": "zsim_formation_v0", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012
    render_mode = None

    def __init__(self, scenario: AnyScenario, **how: Any) -> None:
        self._episodes = _Episodes(scenario, **how)
        self.scenario = self._episodes.scenario
        self.sim = self._episodes.sim
        self.possible_agents = list(self._episodes.interface.agents)
        self.agents: list[str] = []
        self.action_spaces: dict[str, Any] = {**self._episodes.action_spaces}
        self.observation_spaces: dict[str, Any] = {**self._episodes.observation_spaces}
        self._rng = np.random.default_rng()

    def observation_space(self, agent: str) -> Any:
        """Return the space of an agent's observations, the same object each time."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Return the space of an agent's actions, the same object each time."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Floats], dict[str, dict[str, Any]]]:
        """Begin an episode; the same seed gives a bit-identical one."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        return self._episodes.begin(self._rng), {agent: self._episodes.info() for agent in self.agents}

    def step(self, actions: dict[str, Floats]) -> tuple[Any, Any, Any, Any, Any]:
        """Fly one step; return observations, rewards, terminations, truncations and infos by agent."""
        episodes, acting = self._episodes, self.agents
        observed = episodes.step({agent: actions[agent] for agent in acting if agent in actions})
        is_over = self.sim.ended is not None
        rewards = {agent: episodes.reward(agent) for agent in acting}
        terminations = {agent: episodes.terminated(agent) for agent in acting}
        self.agents = [agent for agent in acting if not (terminations[agent] or is_over)]
        observations, infos = {agent: observed[agent] for agent in acting}, {agent: episodes.info() for agent in acting}
        return observations, rewards, terminations, dict.fromkeys(acting, is_over), infos

    def render(self) -> None:
        """Draw nothing; to see a flight, record it and view its report."""

    def close(self) -> None:
        """End the flight."""
        self.sim.close()


class FlightEnv(gymnasium.Env[Floats, Floats]):
    """Gymnasium environment for a scenario, with all agents as one; see `gym_env`."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, scenario: AnyScenario, **how: Any) -> None:
        self._episodes = episodes = _Episodes(scenario, **how)
        self.scenario, self.sim = episodes.scenario, episodes.sim
        self._agents = episodes.interface.agents
        own = [episodes.action_spaces[agent] for agent in self._agents]
        self._cuts = np.cumsum([space.shape[0] for space in own])[:-1]
        size = sum(episodes.interface.size(agent) for agent in self._agents)
        self.action_space = Box(-1.0, 1.0, (sum(space.shape[0] for space in own),), np.float32)
        self.observation_space = Box(-OBSERVATION_MAX, OBSERVATION_MAX, (size,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode; the same seed gives a bit-identical one."""
        super().reset(seed=seed)
        return self._concatenate(self._episodes.begin(self.np_random)), self._episodes.info()

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Fly one step; the reward is the mean over agents, and any agent that terminates ends the episode."""
        parts = np.split(np.asarray(action), self._cuts)
        observations = self._episodes.step(dict(zip(self._agents, parts, strict=True)))
        reward = sum(map(self._episodes.reward, self._agents)) / len(self._agents)
        is_terminated = any(self._episodes.terminated(agent) for agent in self._agents)
        return self._concatenate(observations), reward, is_terminated, self.sim.ended is not None, self._episodes.info()

    def close(self) -> None:
        """End the flight."""
        self.sim.close()

    def _concatenate(self, observations: Mapping[str, NDArray[np.float32]]) -> Floats:
        return np.concatenate([observations[agent] for agent in self._agents])


def parallel_env(scenario: AnyScenario, **settings: Any) -> FormationEnv:
    """Return a PettingZoo environment for a scenario.

    The scenario's controllers do not take part; its estimators do if estimates are observed. `env.scenario` is the
    scenario that is flown: `zsim.run(env.scenario, agents=[MyPolicy])` flies a `zsim.PolicyAgent` bit-identically,
    anywhere.

    Args:
        scenario: path of a YAML file, `zsim.Scenario`, or a mapping as in YAML.
        settings: `reward(sim, agent)`, which is required, and `terminated(sim, agent)`, functions of the
            `zsim.Simulation` after a step and an agent's name, for example `zsim.flipped`; `randomise(rng)`, which
            returns fields of an episode's scenario by path, drawn from a numpy Generator; `observe`: "truth",
            "estimate" or "sensors"; `action`: "velocity", "attitude", "rotors", or "cluster", for which the agents are
            clusters; `step_s`: time between two actions, one gate by default; `duration_s` and `set` as in `zsim.run`.
            For the spaces of observations and actions, see `zsim.Interface`.

    Raises:
        ScenarioError: with one line for every fault in the scenario.
        RunError: the settings do not fit each other or the scenario.
    """
    return FormationEnv(scenario, **_checked(settings))


def gym_env(scenario: AnyScenario, **settings: Any) -> FlightEnv:
    """Return a Gymnasium environment for a scenario, with all agents as one; arguments as in `parallel_env`."""
    return FlightEnv(scenario, **_checked(settings))


def vector_env(
    scenario: AnyScenario, num_envs: int, processes: bool = False, **settings: Any
) -> VectorEnv[Any, Any, Any]:
    """Return several Gymnasium environments as one; each begins its next episode at the step after the end of the last.

    Args:
        scenario: as in `parallel_env`.
        num_envs: number of environments.
        processes: whether each environment has its own process.
        settings: as in `parallel_env`.
    """
    make = partial(gym_env, scenario, **_checked(settings))
    return (AsyncVectorEnv if processes else SyncVectorEnv)([make] * num_envs)


def _checked(settings: Mapping[str, Any]) -> dict[str, Any]:
    parameters = [*signature(_Episodes).parameters][1:]  # without the scenario
    if unknown := [name for name in settings if name not in parameters]:
        raise RunError(f"settings: unknown {', '.join(unknown)}; must be one of {', '.join(parameters)}")
    if "reward" not in settings:
        raise RunError("settings: reward is missing; must be a function of the zsim.Simulation and an agent's name")
    return dict(settings)
