"""Cluster spaces and control laws of a user's own, out of examples/, however a scenario is flown."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from deployment import STEP, in_process
from federation import PAIR, Federation
from forked_commands import ROOT

EXAMPLES = str(ROOT / "examples")
SPACE = "clusters.main.space=leader_cluster:LeaderCluster"
LAW = "clusters.main.law=potential_field:PotentialField"
FLIGHT = ("clusters.main.plan.takeoff_s=1", "drones.drone1.battery_percent=90")
DURATION_S = 10.0  # engaged from 6 s on


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let modules of examples/ be found, here and in what is started from here."""
    monkeypatch.setenv("PYTHONPATH", EXAMPLES)
    monkeypatch.syspath_prepend(EXAMPLES)


def options(*fields: str) -> list[str]:
    settings = [word for field in (*FLIGHT, *fields) for word in ("--set", field)]
    return ["--duration", str(DURATION_S), *settings]


def truth_near(record: Any, drone: str, t_ns: int) -> np.ndarray:
    return np.array(next(t["position_m"] for t in record.all(f"drone/{drone}/truth") if t["t_ns"] >= t_ns))


@pytest.mark.usefixtures("examples")
def test_processes_give_the_bits_of_one_process(federation: Federation, tmp_path: Path) -> None:
    """The origin of the space is robot 1, and it is there that the cluster is led."""
    federation.run(STEP.read_text(), *options(SPACE, LAW)).ends(with_code=0)
    record = federation.record()
    state = record.all("cluster/main/state")[-1]
    assert state["phase"] == "engaged"
    assert np.abs(np.array(state["value"][:3]) - truth_near(record, "drone1", state["t_ns"])).max() < 1.0
    assert record.sha256() == in_process(tmp_path, DURATION_S, [*FLIGHT, SPACE, LAW])


@pytest.mark.usefixtures("examples")
@pytest.mark.soak
def test_a_sweep_compares_laws(federation: Federation) -> None:
    """Also flies the command `zsim run --in-process`, whose hash a run of the sweep has."""
    out = federation.folder / "sweep"
    plan = ("--vary", "clusters.main.law=proportional,potential_field:PotentialField", "--workers", "2", "--no-report")
    federation.start("sweep", str(STEP), *plan, "--out", str(out), *options()).ends(with_code=0)
    first, second = pq.read_table(out / "sweep.parquet").to_pylist()
    assert first["failure"] is second["failure"] is None
    assert first["truth_sha256"] != second["truth_sha256"]
    federation.run(STEP.read_text(), "--in-process", "--seed", str(second["seed"]), *options(LAW)).ends(with_code=0)
    assert federation.record().sha256() == second["truth_sha256"]


def test_a_module_beside_the_scenario_is_found(federation: Federation) -> None:
    for name in ("leader_cluster.py", "potential_field.py"):
        (federation.folder / name).write_text((ROOT / "examples" / name).read_text())
    federation.run(STEP.read_text(), *options(SPACE, LAW)).ends(with_code=0)
    assert federation.record().all("cluster/main/state")[-1]["phase"] == "engaged"


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
    """In one process nothing can catch it; what was recorded until then can be read, and the report says so."""
    (federation.folder / "dying.py").write_text(DYING.replace("DIES_WELL", str(dies_well)))
    federation.run(PAIR, "--in-process", "--set", DIES).ends(with_code=code)
    report = federation.start("report", str(federation.out))
    report.ends(with_code=0)
    assert "incomplete: the end of the run is not on record" in report.text()
    assert federation.record().all("drone/drone1/truth")[-1]["t_ns"] > 2e9


def test_a_law_that_ends_its_process_with_0_is_a_death_that_ends_the_run(federation: Federation) -> None:
    (federation.folder / "dying.py").write_text(DYING.replace("DIES_WELL", "True"))
    run = federation.run(PAIR, "--set", DIES, "--set", "processes.on_death={controller: end}")
    run.ends(with_code=1)
    assert "controller.main" in run.text().splitlines()[-1]
