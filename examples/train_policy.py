# pyright: reportMissingImports=false
"""Train a policy that flies a drone home against the wind, with stable-baselines3's PPO; then fly it as an agent.

    pip install -e '.[soak]'
    PYTHONPATH=examples python examples/train_policy.py --steps 30000 --out build/home
    PYTHONPATH=examples zsim run build/home/home.yaml --agent "train_policy:Trained file=build/home/policy.zip"

A process on any host can fly it too: `zsim agent train_policy:Trained file=... --connect ...`; see docs/learning.md.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TransformAction
from numpy.typing import ArrayLike, NDArray
from stable_baselines3 import PPO

import zsim

HOME_M = (0.0, 0.0, 2.0)  # in W
START_M = 3.0  # the start is at most this far from the origin along x and along y
LIMIT = (0.4, 0.4, 1.0)  # fractions of the firmware's limits: 2 m/s forward and left, 1 m/s up; no yaw
STEP_S = 0.2
STEP = Path(__file__).parents[1] / "scenarios/step.yaml"  # has the paper's sensors, gusts and delay
SCENARIO = zsim.Scenario.load(STEP).with_(
    name="home", drones=[{"name": "drone1", "position_m": [0, 0, 0]}], clusters=[], report={}, duration_s=12
)


def near_home(sim: zsim.Simulation, agent: str) -> float:
    """Return the reward of a step: minus the true distance from home [m]."""
    return -float(np.linalg.norm(sim.truth.position_m[sim.names.index(agent)] - HOME_M))


def drawn(rng: np.random.Generator) -> Mapping[str, Any]:
    """Return a random start and wind for an episode."""
    x, y = rng.uniform(-START_M, START_M, 2).tolist()
    return {
        "drones.drone1.position_m": [x, y, 0.0],
        "environment.wind.steady_m_s": [*rng.normal(0, 1, 2).tolist(), 0.0],
    }


def home_env() -> TransformAction[Any, Any, Any]:
    """Return the environment, with estimates as observations and three velocities as the action."""
    env = zsim.gym_env(SCENARIO, reward=near_home, randomise=drawn, observe="estimate", step_s=STEP_S)
    return TransformAction(env, velocities, Box(-1.0, 1.0, (3,), np.float32))


def velocities(action: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert an action of the policy (3,) to one of `zsim.Interface` (4,)."""
    return np.append(action * LIMIT, 0.0).astype(np.float32)


def learner(seed: int = 1) -> PPO:
    """Return PPO with an untrained policy."""
    settings: dict[str, Any] = {"n_steps": 1024, "gamma": 0.95, "learning_rate": 1e-3}
    return PPO("MlpPolicy", home_env(), **settings, policy_kwargs={"log_std_init": -0.5}, seed=seed, device="cpu")


def episode_rewards(model: PPO, seeds: range) -> NDArray[np.float64]:
    """Return the policy's total reward in each episode (len(seeds),), flown without exploration."""
    env = home_env()
    return np.array([flown(model, env, seed) for seed in seeds])


def flown(model: PPO, env: TransformAction[Any, Any, Any], seed: int) -> float:
    """Fly an episode without exploration; return its total reward."""
    seen, _ = env.reset(seed=seed)
    total, is_over = 0.0, False
    while not is_over:
        seen, reward, is_terminated, is_truncated, _ = env.step(model.predict(seen, deterministic=True)[0])
        total, is_over = total + float(reward), is_terminated or is_truncated
    return total


class Trained(zsim.PolicyAgent):
    """The trained policy as an agent; `file` was written by `PPO.save`."""

    observe, action, step_s = "estimate", "velocity", STEP_S

    def __init__(self, file: str) -> None:
        self.model = PPO.load(file, device="cpu")

    def policy(self, observations: dict[str, NDArray[np.float32]]) -> Mapping[str, ArrayLike]:
        """Return the action of each drone for its observation."""
        return {
            drone: velocities(self.model.predict(seen, deterministic=True)[0]) for drone, seen in observations.items()
        }


def main() -> None:
    """Train, save the policy and the scenario, and print the mean rewards before and after."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("build/home"))
    given = parser.parse_args()
    model = learner(given.seed)
    print(f"before: {episode_rewards(model, range(20)).mean():.1f} per episode")
    model.learn(given.steps)
    print(f"after:  {episode_rewards(model, range(20)).mean():.1f} per episode")
    given.out.mkdir(parents=True, exist_ok=True)
    model.save(given.out / "policy.zip")
    env = zsim.gym_env(SCENARIO, reward=near_home, observe="estimate", step_s=STEP_S)
    env.scenario.save(given.out / "home.yaml")


if __name__ == "__main__":
    main()
