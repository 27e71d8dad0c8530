"""Cluster spaces and control laws of a user's own, out of examples/, however a scenario is flown."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deployment import STEP, in_process
from federation import PAIR, Federation
from forked_commands import ROOT

EXAMPLES = str(ROOT / "examples")
SPACE = "clusters.main.space=leader_cluster:LeaderCluster"
LAW = "clusters.main.law=potential_field:PotentialField"
FLIGHT = ("clusters.main.plan.takeoff_s=1", "drones.drone1.battery_percent=90")
DURATION_S = 10.0  # engaged from 6 s on


def options(*fields: str) -> list[str]:
    settings = [word for field in (*FLIGHT, *fields) for word in ("--set", field)]
    return ["--duration", str(DURATION_S), *settings]


def truth_near(record: Any, drone: str, t_ns: int) -> np.ndarray:
    return np.array(next(t["position_m"] for t in record.all(f"drone/{drone}/truth") if t["t_ns"] >= t_ns))


def test_processes_with_modules_beside_the_scenario_give_the_bits_of_one_process_that_imports_them(
    federation: Federation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The origin of the space is robot 1, and it is there that the cluster is led."""
    for name in ("leader_cluster.py", "potential_field.py"):
        (federation.folder / name).write_text((ROOT / "examples" / name).read_text())
    federation.run(STEP.read_text(), *options(SPACE, LAW)).ends(with_code=0)
    record = federation.record()
    state = record.all("cluster/main/state")[-1]
    assert state["phase"] == "engaged"
    assert np.abs(np.array(state["value"][:3]) - truth_near(record, "drone1", state["t_ns"])).max() < 1.0
    monkeypatch.syspath_prepend(EXAMPLES)
    assert record.sha256() == in_process(tmp_path, DURATION_S, [*FLIGHT, SPACE, LAW])


@pytest.mark.parametrize(("field", "how"), [("space", ["--in-process"]), ("law", [])])
def test_a_class_that_is_not_there_is_one_line(federation: Federation, field: str, how: list[str]) -> None:
    run = federation.run(STEP.read_text(), *how, *options(f"clusters.main.{field}=nowhere.at_all:Missing"))
    run.ends(with_code=2)
    assert "cluster 'main'" in run.line("nowhere.at_all:Missing").text
    assert "Traceback" not in run.text()


DYING = """
import os

import numpy as np
from zsim_agents.formation.control_law import ControlLaw


class Dies(ControlLaw):
    calls = 0

    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        self.calls += 1
        if self.calls > 100:
            os._exit(0) if DIES_WELL else os.kill(os.getpid(), 9)
        return np.zeros(self.space.size)
"""
DIES = "clusters.main.law=dying:Dies"


@pytest.mark.parametrize(("dies_well", "code"), [(False, -9), (True, 0)])
def test_a_law_that_ends_its_process_leaves_a_record_without_an_end(
    federation: Federation, dies_well: bool, code: int
) -> None:
    """In one process nothing can catch it; what was recorded until then can be read."""
    (federation.folder / "dying.py").write_text(DYING.replace("DIES_WELL", str(dies_well)))
    federation.run(PAIR, "--in-process", "--set", DIES).ends(with_code=code)
    record = federation.record()
    assert record.events("end") == []
    assert record.all("drone/drone1/truth")[-1]["t_ns"] > 2e9


def test_a_law_that_ends_its_process_with_0_is_a_death_that_ends_the_run(federation: Federation) -> None:
    (federation.folder / "dying.py").write_text(DYING.replace("DIES_WELL", "True"))
    run = federation.run(PAIR, "--set", DIES, "--set", "processes.on_death={controller: end}")
    run.ends(with_code=1)
    assert "controller.main" in run.text().splitlines()[-1]
