"""stable-baselines3 trains the policy of examples/train_policy.py, which then flies the same bits as an agent."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import zsim

pytestmark = pytest.mark.soak
STEPS = 20_000
JUDGED = range(20)  # seeds of the evaluation episodes


def test_a_policy_learns_and_flies_as_an_agent(tmp_path: Path) -> None:
    needed = "stable-baselines3 is not installed; `pip install -e .[soak]` brings it"
    pytest.importorskip("stable_baselines3", reason=needed)
    import train_policy

    model = train_policy.learner(seed=1)
    before = train_policy.episode_rewards(model, JUDGED).mean()
    model.learn(STEPS)
    after = train_policy.episode_rewards(model, JUDGED).mean()
    print(f"mean reward of an episode: {before:.1f} before, {after:.1f} after {STEPS} steps")
    assert after > before / 2  # both are negative: less than half the distance from home

    env = train_policy.home_env()
    train_policy.flown(model, env, seed=100)
    sim: zsim.Simulation = env.get_wrapper_attr("sim")
    sim.source.save(tmp_path / "home.yaml")
    model.save(tmp_path / "policy.zip")
    flight = ["home.yaml", "--agent", "train_policy:Trained file=policy.zip", "--out", "run"]
    command = [sys.executable, "-m", "zsim_deploy", "run", *flight]
    paths = {"PYTHONPATH": str(Path(train_policy.__file__).parent)}
    ended = subprocess.run(command, cwd=tmp_path, env={**os.environ, **paths}, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert zsim.load(tmp_path / "run").truth_sha256 == sim.truth_sha256
