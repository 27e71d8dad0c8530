"""Hosting of agents: selection by names and patterns, shared processes, and checks before a run."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from refused import has_terms, refused

from zsim.errors import RunError, ScenarioError
from zsim.runtime.agent import AgentGroup
from zsim.scenario import scenario_file
from zsim.scenario.roles import AGENTS, Role, expected_processes, rights_for
from zsim.transport.tls import Identity
from zsim_agents.hosting import agents_of, check_classes, check_plans, chosen, hosted, make_agents
from zsim_deploy.roles import roles
from zsim_world.run.world import World

SCENARIOS = Path(__file__).parents[3] / "scenarios"
STEP, TRAJECTORY = scenario_file.load(SCENARIOS / "step.yaml"), SCENARIOS / "trajectory.yaml"
ESTIMATORS = ["estimator.drone1", "estimator.drone2", "estimator.drone3"]


@pytest.mark.parametrize(
    ("patterns", "wanted"),
    [
        (["*"], [*ESTIMATORS, "controller.main"]),
        (["controller.main", "estimator.*"], [*ESTIMATORS, "controller.main"]),
        (["estimator.drone3", "estimator.drone1"], ["estimator.drone1", "estimator.drone3"]),
        (["estimator.drone[12]"], ESTIMATORS[:2]),
    ],
)
def test_agents_are_selected_by_names_and_patterns(patterns: list[str], wanted: list[str]):
    assert agents_of(STEP, patterns) == wanted


def test_a_pattern_without_a_match_is_refused_with_ten_names():
    pattern = r"estimator: drone is 'dorne\*'; must match one of drone1, drone2, drone3$"
    with pytest.raises(RunError, match=pattern):
        chosen("estimator: drone", ["drone1", "dorne*"], ["drone1", "drone2", "drone3"])
    with refused(RunError, "d0", "d1", "d2", "d3", "d4", "d5", "d6", "d7", "d8", "d9", "90"):
        chosen("estimator: drone", ["x"], [f"d{i}" for i in range(100)])


def test_hosted_agents_form_one_group_with_the_controller_last(tmp_path: Path):
    group = hosted(World(STEP).info(), STEP, ["*"])
    assert isinstance(group, AgentGroup)
    assert (group.name, group.serves) == ("controller.main", tuple(ESTIMATORS))
    assert group.gate_keys == tuple(f"drone/drone{i}/sensor/status" for i in (1, 2, 3))
    with refused(RunError, "controller.main", "certificate", "estimator.drone1"):  # a certificate is for one process
        roles.check_certificate(group, Identity(tls=tmp_path))
    roles.check_certificate(group, Identity())
    made = roles.agent_of("estimator", ["drone*"])(World(STEP).info(), STEP)
    assert (made.name, made.serves) == ("estimator.drone1", ("estimator.drone2", "estimator.drone3"))


def test_a_role_is_defined_by_its_row_in_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The names, agents, extra and rights of a role follow from the row."""
    (tmp_path / "altimeter_of_mine.py").write_text(ALTIMETER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(AGENTS, "altimeter", Role("agents", "drop", "drone", "altimeter_of_mine:Altimeter"))
    altimeters = [f"altimeter.drone{i}" for i in (1, 2, 3)]
    assert agents_of(STEP) == [*ESTIMATORS, "controller.main", *altimeters]
    assert expected_processes(STEP) == agents_of(STEP)
    group = hosted(World(STEP).info(), STEP, ["altimeter.*"])
    assert (group.name, group.serves) == (altimeters[-1], tuple(altimeters[:-1]))
    assert rights_for(altimeters[0], STEP).writes == (
        *(f"process/altimeter.drone1/{what}" for what in ("join", "done", "snapshot", "bye", "health")),
        "drone/drone1/estimate",
        "view/estimates/altimeter.drone1",
    )
    assert rights_for("altimeter.main", STEP).answers == ("process/altimeter.main/outputs",)


ALTIMETER = """
from zsim.runtime.agent import Agent

class Altimeter(Agent):
    def __init__(self, info, scenario, drone):
        super().__init__()
        self.name, self.period_ns = f"altimeter.{drone}", info.gate_ns
        self.reads = self.gate_keys = (f"drone/{drone}/sensor/status",)

    def receive(self, key, message): pass
    def step(self, t_ns): return []
"""


def test_all_classes_named_in_a_scenario_are_checked_before_a_run():
    names = ["no.estimator:A", "no.space:B", "no.law:C"]
    paths = ("estimation.algorithm", "clusters.main.space", "clusters.main.law")
    overrides = [f"{path}={name}" for path, name in zip(paths, names, strict=True)]
    with pytest.raises(ScenarioError) as raised:
        check_classes(scenario_file.load(SCENARIOS / "step.yaml", overrides), "step.yaml")
    assert [next(name for name in names if name in line) for line in raised.value.faults] == names
    check_classes(STEP, "step.yaml")


UNFLYABLE = {
    "x_c=9**9**9": ("clusters[0].plan.trajectory.expressions.x_c", "'9**9**9'"),
    "x_c=__import__('os')": ("clusters[0].plan.trajectory.expressions.x_c", "calls '__import__'"),
    "bogus=1+t": ("'bogus'", "x_c"),
}


@pytest.mark.parametrize("assignment", UNFLYABLE)
def test_a_plan_is_refused_with_the_text_of_the_controller(assignment: str):
    name, _, text = assignment.partition("=")
    path = f"clusters.main.plan.trajectory.expressions.{name}={text}"
    scenario = scenario_file.load(TRAJECTORY, [path])
    info = SimpleNamespace(gate_ns=20_000_000)
    with pytest.raises(RunError) as refusal:
        make_agents("controller", info, scenario, ["main"])  # type: ignore[arg-type]
    with pytest.raises(ScenarioError) as raised:
        check_plans(scenario, "trajectory.yaml")
    assert raised.value.faults == [f"trajectory.yaml: {refusal.value}"]
    assert has_terms(str(refusal.value), *UNFLYABLE[assignment])


@pytest.mark.parametrize(
    ("override", "path"),
    [
        ("plan.target={yaw: 90}", "plan.target.yaw"),
        ("plan.target={gap: 9}", "plan.target:"),
        ("plan.trajectory.expressions.yaw=0.1*w*t", "plan.trajectory.expressions.yaw:"),
        ("plan.trajectory={waypoints: [{at_s: 0, values: {yaw: 45}}]}", "plan.trajectory.waypoints[0].values.yaw"),
        ("plan.land_s=5", "plan.land_s"),
    ],
)
def test_an_infeasible_plan_is_refused_with_its_path_in_the_scenario(override: str, path: str):
    scenario = scenario_file.load(TRAJECTORY, [f"clusters.main.{override}"])
    with pytest.raises(ScenarioError) as raised:
        check_plans(scenario, "trajectory.yaml")
    assert [line.split(" ")[1] for line in raised.value.faults] == [f"clusters[0].{path}"]


def test_numbers_and_expressions_are_interchangeable():
    overrides = ["clusters.main.plan.trajectory.expressions.z_c=6", "clusters.main.plan.target={yaw: pi/2}"]
    scenario = scenario_file.load(TRAJECTORY, overrides)
    check_plans(scenario, "trajectory.yaml")
    assert scenario_file.from_text(scenario_file.to_text(scenario)) == scenario
