"""Environments: the checkers of PettingZoo and Gymnasium, and identity with flights of the same policy."""

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pair_flight
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test
from refused import refused

import zsim
from zsim.errors import RunError, UserCodeError

PAIR: dict[str, Any] = {**pair_flight.PAIR, "duration_s": 6.4, "environment": {"wind": {"gust_m_s": 0.5}}}
FLOWN = [("truth", "velocity"), ("estimate", "attitude"), ("sensors", "rotors"), ("estimate", "cluster")]


def stays(sim: zsim.Simulation, agent: str) -> float:
    return -float(np.abs(sim.truth.velocity_m_s).sum())


def made(**settings: Any) -> Any:
    return zsim.parallel_env(PAIR, **{"reward": stays, "step_s": 0.1, **settings})


@pytest.mark.filterwarnings("ignore:.*observation space.*")
@pytest.mark.parametrize(("observe", "action"), FLOWN)
def test_the_environment_passes_pettingzoo_s_tests(observe: str, action: str) -> None:
    parallel_api_test(made(observe=observe, action=action, terminated=zsim.far_away(20.0)), num_cycles=60)
    parallel_seed_test(lambda: made(observe=observe, action=action), num_cycles=15)


@pytest.mark.parametrize(("observe", "action"), FLOWN)
def test_the_environment_passes_gymnasium_s_checker(observe: str, action: str) -> None:
    check_env(zsim.gym_env(PAIR, reward=stays, step_s=0.1, observe=observe, action=action), skip_render_check=True)


def push(agent: str, seen: np.ndarray) -> np.ndarray:
    """Return an action that depends on the whole observation."""
    return np.tanh(np.resize(seen, 8 if agent == "main" else 4)) * 0.3


class Pushed(zsim.PolicyAgent):
    step_s = 0.1

    def policy(self, observations: dict[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        return {agent: push(agent, seen) for agent, seen in observations.items()}


@pytest.mark.parametrize(("observe", "action"), FLOWN)
def test_a_policy_flies_identically_in_an_environment_and_as_an_agent(
    observe: Any, action: Any, tmp_path: Path
) -> None:
    env = made(observe=observe, action=action)
    seen, _ = env.reset(seed=5)
    while env.agents:
        seen, *_ = env.step({agent: push(agent, seen[agent]) for agent in env.agents})
    flown = env.sim.source  # the scenario of the episode
    kind = type("Flying", (Pushed,), {"observe": observe, "action": action, "__module__": __name__})
    run = zsim.run(flown, agents=[kind], out=tmp_path / "run", progress=False)
    assert run.truth_sha256 == env.sim.truth_sha256
    assert len(run.commands("d1", "mode")) >= 1
    env.close()


def test_an_episode_begins_in_the_air_and_ends_with_the_scenario() -> None:
    env = made()
    seen, infos = env.reset(seed=1)
    assert {env.sim.state("d1"), env.sim.state("d2")} <= {"hovering", "flying"}
    assert infos["d1"] == {"t_s": env.sim.t_s, "command_delay_s": 0.02}
    before = np.array(seen["d1"])
    rewards = ended = cut = {}
    np.testing.assert_allclose(seen["d1"][:3], env.sim.truth.position_m[0], rtol=1e-6)
    np.testing.assert_allclose(seen["d1"][13:16], env.sim.truth.position_m[1] - env.sim.truth.position_m[0], rtol=1e-6)
    while env.agents:
        seen, rewards, ended, cut, infos = env.step({agent: np.array([0.4, 0, 0, 0]) for agent in env.agents})
    assert infos["d1"]["t_s"] == pytest.approx(6.4)
    assert cut == {"d1": True, "d2": True}
    assert ended == {"d1": False, "d2": False}
    assert seen["d1"][0] > before[0] + 0.5
    assert rewards["d1"] < 0


def test_conditions_end_the_episode_of_a_drone() -> None:
    env = made(terminated=zsim.any_of(zsim.far_away(2.5), zsim.flipped, zsim.collided))
    env.reset(seed=1)
    ended: dict[str, bool] = {}
    while "d2" in env.agents and not ended.get("d1"):
        rest = np.zeros(4, np.float32)
        _, _, ended, _, _ = env.step({"d1": np.array([0.8, 0, 0, 0]), "d2": rest})
    assert ended == {"d1": True, "d2": False}
    assert env.agents == ["d2"]


def test_episodes_are_drawn_from_the_seed() -> None:
    def drawn(rng: np.random.Generator) -> dict[str, float]:
        return {"environment.wind.gust_m_s": float(rng.uniform(0, 3))}

    env = made(randomise=drawn)
    gusts = []
    for seed in (4, None, 4, None):
        env.reset(seed=seed)
        gusts.append(env.sim.scenario.environment.wind.gust_m_s)
    assert gusts[:2] == gusts[2:]
    assert len(set(gusts)) == 2


@pytest.mark.parametrize("processes", [False, True])
def test_vectorised_environments_equal_a_single_one(processes: bool) -> None:
    envs: Any = zsim.vector_env(PAIR, 2, processes=processes, reward=stays, step_s=0.1)
    first, _ = envs.reset(seed=[1, 2])
    assert first.shape == (2, 2 * (13 + 6))
    alone = zsim.gym_env(PAIR, reward=stays, step_s=0.1)
    np.testing.assert_array_equal(alone.reset(seed=2)[0], first[1])
    assert envs.metadata["autoreset_mode"] is not None
    action = np.zeros(envs.action_space.shape, np.float32)
    seen, rewards, *_ = envs.step(action)
    np.testing.assert_array_equal(alone.step(action[1])[0], seen[1])
    assert rewards.shape == (2,)
    envs.close()


def test_invalid_settings_are_refused() -> None:
    with refused(RunError, "reward", "missing"):
        zsim.parallel_env(PAIR)
    with refused(RunError, "actoin", "action,"):
        zsim.parallel_env(PAIR, reward=stays, actoin="velocity")
    with refused(RunError, "observe", "'radar';", "truth,"):
        made(observe="radar")
    with refused(RunError, "step_s", "0.03;", "0.02"):
        made(step_s=0.03)
    with refused(RunError, "'sensors'", "'estimate'"):
        made(observe="sensors", action="cluster")
    with refused(RunError, "'cluster',", "'alone'"):
        zsim.parallel_env({**PAIR, "name": "alone", "clusters": []}, reward=stays, action="cluster")


class Wrong(Pushed):
    def policy(self, observations: dict[str, np.ndarray]) -> Any:
        return {agent: np.zeros(3) for agent in observations}


class NotANumber(Pushed):
    def policy(self, observations: dict[str, np.ndarray]) -> Any:
        return {agent: np.full(4, np.nan) for agent in observations}


@pytest.mark.parametrize(("kind", "terms"), [(Wrong, ("(3,);", "(4,)")), (NotANumber, ("nan,", "finite"))])
def test_an_invalid_action_is_reported_with_class_agent_and_shapes(kind: type, terms: Any, tmp_path: Path) -> None:
    scenario = made().scenario
    with refused(UserCodeError, f"{kind.__module__}:{kind.__qualname__}.policy", "d1", *terms):
        zsim.run(scenario, agents=[kind], out=tmp_path / "run", progress=False)


def test_an_action_is_clamped_to_its_bounds() -> None:
    env = made()
    env.reset(seed=1)
    space = env.action_space("d1")
    assert space is env.action_space("d1")
    low, high = zsim.Interface(env.sim.scenario, "truth", "velocity").bounds("d1")
    assert high.tolist() == (-low).tolist() == pytest.approx([5, 5, 1, np.radians(200)])
    far, _ = made(), None
    far.reset(seed=1)
    for _ in range(3):
        env.step(dict.fromkeys(env.agents, space.high))
        far.step(dict.fromkeys(far.agents, 10 * space.high))
    assert env.sim.truth_sha256 == far.sim.truth_sha256
    assert pickle.loads(pickle.dumps(space)) == space
