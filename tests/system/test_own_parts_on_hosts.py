"""Sensors, a vehicle, an estimator, a space and a law of the user's own, flown together by `zsim up` on several hosts."""

import shutil
from pathlib import Path

import pytest
from deployment import ROLES, START_S, STEP, Deployment, closing
from federation import Record
from forked_commands import ROOT
from lab import Lab

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
def test_they_fly_as_in_one_process(lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules of sensors and vehicles need be only where the scenario is read and where the world is."""
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
