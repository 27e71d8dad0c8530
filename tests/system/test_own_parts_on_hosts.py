"""User sensors, vehicles, estimators, cluster spaces, laws, agents and programs with `zsim up` on several hosts."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from deployment import ROLES, START_S, STEP, Deployment, closing
from federation import Record
from forked_commands import ROOT
from lab import Lab

import zsim
from zsim.record import RecordReader
from zsim.scenario import scenario_file
from zsim_analysis.in_process import fly

EXAMPLES = ROOT / "examples"
OF_THE_WORLD = (
    "sensors.my_uwb={module: uwb_range, anchor_m: [0, 0, 2]}",
    "sensors.pitot={module: airspeed, latency_ms: 30}",
    "drones.drone1.model=larger_battery",
)
OF_AGENTS = (
    "estimation.algorithm=my_estimator:MyEstimator",
    "clusters.main.space=leader_cluster:LeaderCluster",
    "clusters.main.law=potential_field:PotentialField",
)
FIELDS = (*OF_THE_WORLD, *OF_AGENTS, "clusters.main.plan.takeoff_s=1")
DURATION_S = 10.0
KEYS = ("drone/drone1/sensor/my_uwb", "drone/drone2/sensor/pitot", "drone/drone3/estimate", "cluster/main/state")


@pytest.mark.soak
def test_user_parts_on_hosts_fly_as_in_one_process(lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules of sensors and vehicles are needed only on the launcher and on the world's host."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES))
    (tmp_path / "agents").mkdir()
    for name in ("my_estimator", "leader_cluster", "potential_field"):
        shutil.copy(EXAMPLES / f"{name}.py", tmp_path / "agents")
    lab.environment("h1", PYTHONPATH=str(EXAMPLES))
    for host in ("h2", "h3"):
        lab.environment(host, PYTHONPATH=str(tmp_path / "agents"))
    alone = tmp_path / "alone.mcap"
    fly(scenario_file.load(STEP, FIELDS, duration_s=DURATION_S), alone)
    options = ["--duration", str(DURATION_S), *(word for field in FIELDS for word in ("--set", field))]
    with closing(Deployment(lab, ROLES)) as deployment, RecordReader(alone) as reader:
        deployment.up(*options).ends(with_code=0, within_s=START_S)
        record, one = deployment.record(), Record(reader)
        for key in KEYS:
            columns = [[{**message, "source": ""} for message in each.all(key)] for each in (record, one)]
            assert columns[0] == columns[1] != [], key
        assert record.sha256() == one.sha256()


@pytest.mark.soak
def test_communicating_drones_on_hosts_fly_as_in_one_process(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES))
    for host in lab.names:
        lab.environment(host, PYTHONPATH=str(EXAMPLES))
    pentagon, alone = EXAMPLES / "swarm.yaml", tmp_path / "alone.mcap"
    fly(scenario_file.load(pentagon, duration_s=DURATION_S), alone)
    spread = {"world": "h1", "estimator.*": ["h1", "h2", "h3"], "pilot.*": ["h2", "h3", "h1"]}
    with closing(Deployment(lab, spread, scenario=pentagon)) as deployment, RecordReader(alone) as reader:
        deployment.up("--duration", str(DURATION_S)).ends(with_code=0, within_s=START_S)
        record = deployment.record()
        assert record.sha256() == Record(reader).sha256()
        assert len(record.all("swarm/drone1/position")) == DURATION_S / 0.02 + 1


def test_an_unplaced_program_runs_on_the_launcher_and_its_failure_is_reported(
    lab: Lab, tmp_path: Path, forked: None
) -> None:
    """Its flight has the same bits as under `zsim run`."""
    client, dies = EXAMPLES / "plain_client.yaml", tmp_path / "dies.yaml"
    dies.write_text(
        client.read_text().replace("[python, plain_client.py, '{endpoint}']", "[sh, -c, echo lost; exit 3]")
    )
    alone = zsim.run(client, duration_s=3, processes=True, out=tmp_path / "alone", progress=False)
    spread = {"world": "h1", "estimator.*": "h2"}
    with closing(Deployment(lab, spread, secure=False, scenario=client)) as deployment:
        deployment.up("--duration", "3").ends(with_code=0, within_s=START_S)
        assert "flying" in (deployment.out / "logs" / "plain.client.log").read_text()
        assert deployment.record().sha256() == alone.truth_sha256
        deployment.scenario, deployment.out = dies, tmp_path / "died"
        failed = deployment.up()
        failed.ends(with_code=1, within_s=START_S)
        assert "exit code 3: lost" in failed.text()


POLICY = """
from pathlib import Path

import numpy as np
import zsim


class Trained(zsim.PolicyAgent):
    observe, action, step_s = "estimate", "velocity", 0.1
    weights = np.load(Path(__file__).with_name("weights.npy"))

    def policy(self, observations):
        return {drone: np.tanh(self.weights @ [seen[2] - 2.0, seen[5]]) for drone, seen in observations.items()}
"""


@pytest.mark.soak
def test_a_trained_policy_on_hosts_flies_the_bits_of_its_environment(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training is a random search for the linear policy that best keeps the drones at 2 m."""
    modules, rng = tmp_path / "modules", np.random.default_rng(1)
    modules.mkdir()
    monkeypatch.syspath_prepend(str(modules))
    monkeypatch.setenv("PYTHONPATH", str(modules))
    for host in lab.names:
        lab.environment(host, PYTHONPATH=str(modules))
    drones = [{"name": f"drone{i}", "position_m": [0.0, 10.0 * i - 10.0, 0.0]} for i in range(3)]
    pair: dict[str, Any] = {"name": "three", "duration_s": DURATION_S, "drones": drones}
    (tmp_path / "three.yaml").write_text(yaml.safe_dump(pair))
    env = zsim.parallel_env(
        tmp_path / "three.yaml",
        reward=lambda sim, drone: -abs(sim.truth.position_m[sim.names.index(drone), 2] - 2.0),
        observe="estimate",
        action="velocity",
        step_s=0.1,
    )

    def episode(weights: Any) -> float:
        seen, _ = env.reset(seed=5)
        total = 0.0
        while env.agents:
            actions = {drone: np.tanh(weights @ [each[2] - 2.0, each[5]]) for drone, each in seen.items()}
            seen, rewards, *_ = env.step(actions)
            total += sum(rewards.values())
        return total

    up = np.array([0.0, 0.0, 1.0, 0.0])  # direction of an action
    tried = [np.outer(up, -rng.uniform(0.0, 1.0, 2)) for _ in range(4)]
    best = max(tried, key=episode)
    np.save(modules / "weights.npy", best)
    (modules / "trained.py").write_text(POLICY)
    episode(best)
    pair["agents"] = {"policy": {"class": "trained:Trained", "per": "run"}}
    (tmp_path / "flown.yaml").write_text(yaml.safe_dump({**pair, "seed": env.sim.source.resolved.seed}))
    spread = {"world": "h1", "estimator.*": ["h1", "h2"], "policy.main": "h3"}
    with closing(Deployment(lab, spread, scenario=tmp_path / "flown.yaml")) as deployment:
        deployment.up().ends(with_code=0, within_s=START_S)
        assert deployment.record().sha256() == env.sim.truth_sha256
