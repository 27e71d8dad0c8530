"""The engagement of a scenario: its law, its space, and the refusal of infeasible plans."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from refused import has_terms, refused

from zsim.errors import RunError, ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.control_law import ControlLaw, ProportionalLaw
from zsim_agents.formation.engagement_setup import check_plan, engagement_of
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, SingularClusterError
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.spaces.triad_cluster import TriadCluster

SCENARIOS = Path(__file__).parents[4] / "scenarios"
HERE = """
import numpy as np
from zsim_agents.formation.control_law import ControlLaw
from zsim_agents.formation.spaces.triad_cluster import TriadCluster

class Still(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return np.zeros(self.space.size)

class Short(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return np.zeros(3)

class Lost(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        r_dot = np.zeros(self.space.size)
        r_dot[6] = np.nan
        return r_dot

class Nothing(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return None

class Raises(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return divided(self.space.size)

def divided(size):
    return size / 0

class Half(ControlLaw):
    pass

class Flat(TriadCluster):
    def forward(self, p_W, yaw):
        return super().forward(p_W, yaw)[:3]

class Lame(TriadCluster):
    def motion(self, c, c_dot):
        r_dot = super().motion(c, c_dot)
        r_dot[2] = np.inf
        return r_dot

class Named(TriadCluster):
    @classmethod
    def for_places(cls, places_m):
        made = cls(len(places_m))
        made.places = places_m
        return made
"""


class Rates(ControlLaw):
    """A law that commands given rates and adds up the time for which they are followed."""

    def __init__(self, space: ClusterSpace, r_dot: Array) -> None:
        super().__init__(space)
        self.r_dot, self.followed_s = r_dot, 0.0

    def rates(self, c: Array, p_W: Array, v_W: Array, c_des: Array, c_dot_des: Array) -> Array:
        return self.r_dot

    def followed(self, dt_s: float) -> None:
        self.followed_s += dt_s


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "formation_of_mine.py").write_text(HERE)
    monkeypatch.syspath_prepend(tmp_path)
    return "formation_of_mine"


def scenario(**cluster: Any) -> Scenario:
    return scenario_file.load(
        SCENARIOS / "step.yaml", [f"clusters.main.{field}={value}" for field, value in cluster.items()]
    )


def test_a_user_s_law_is_loaded_and_the_built_in_one_by_default(module: str) -> None:
    made = scenario(law=f"{module}:Still")
    law = engagement_of(made, made.clusters[0]).law
    assert type(law).__name__ == "Still"
    assert law.gains.k_1_s == made.clusters[0].gains.proportional_1_s
    plain, named = scenario(), scenario(law="proportional")
    for made in (plain, named):
        assert type(engagement_of(made, made.clusters[0]).law) is ProportionalLaw
    assert "law" not in scenario_file.to_text(plain)
    assert scenario_file.from_text(scenario_file.to_text(named)).clusters[0].law == "proportional"


def test_a_user_s_space_gets_the_places_of_its_robots(module: str) -> None:
    made = scenario(space=f"{module}:Named", template_m="[[1, 0, 0], [0, 1, 0], [0, -1, 0]]")
    space: Any = engagement_of(made, made.clusters[0]).space
    assert space.places.tolist() == [[1, 0, 0], [0, 1, 0], [0, -1, 0]]
    with refused(ValueError, "11", "2"):  # its variables do not match the number of robots
        TriadCluster(2)


@pytest.mark.parametrize(
    ("field", "name", "terms"),
    [
        ("law", "nowhere:Law", ("ModuleNotFoundError",)),
        ("law", "formation_of_mine:Other", ("Half", "Lost", "Named", "Nothing", "Raises", "Short", "Still")),
        ("law", "formation_of_mine:Half", ("rates()",)),
        ("law", "formation_of_mine:Short", ("(3,)",)),
        ("law", "formation_of_mine:Lost", ("formation_of_mine:Lost.rates", "nan", "vz", "drone2")),
        ("law", "formation_of_mine:Nothing", ("formation_of_mine:Nothing.rates", "null", "12")),
        ("law", "formation_of_mine:Raises", ("mine:Raises.rates", "ZeroDivisionError", "formation_of_mine.py:29")),
        ("space", "formation_of_mine:Flat", ("formation_of_mine:Flat.forward", "(3,)", "(12,)")),
        ("space", "formation_of_mine:Lame", ("formation_of_mine:Lame.motion", "inf", "2")),
        ("space", "formation_of_mine:Still", ("forward",)),
        ("space", "nowhere:Space", ("ModuleNotFoundError",)),
    ],
)
def test_an_unusable_law_or_space_is_refused(module: str, field: str, name: str, terms: tuple[str, ...]) -> None:
    made = scenario(**{field: name})
    with pytest.raises(RunError) as raised:
        engagement_of(made, made.clusters[0])
    line = str(raised.value)
    assert line.startswith("cluster 'main'")
    assert all(term in line for term in terms), line
    assert "\n" not in line


@pytest.mark.parametrize(("field", "stock"), [("space", "triad, template"), ("law", "proportional")])
def test_an_unknown_law_or_space_is_a_fault_of_the_scenario(field: str, stock: str) -> None:
    with pytest.raises(ScenarioError) as raised:
        scenario(**{field: "tirad"})
    (line,) = raised.value.faults
    assert f"clusters[0].{field} is 'tirad'" in line
    assert stock in line
    assert "(cluster 'main')" in line


@pytest.mark.parametrize(("speed_m_s", "followed_s"), [(0.1, 0.02), (100.0, 0.0)])
def test_every_law_is_saturated_and_notified_when_it_is_followed(speed_m_s: float, followed_s: float) -> None:
    space = cluster_space(3)
    law = Rates(space, np.tile([speed_m_s, 0.0, 0.0, 0.0], 3))
    c = space.specimen(5.0)
    p_W, _ = space.inverse(c)
    command = law.command(c, p_W, np.zeros((3, 3)), c, np.zeros(12), 0.02)
    assert law.followed_s == followed_s
    assert command.v_W[:, 0] == pytest.approx(min(speed_m_s, law.gains.speed_max_m_s))


# Plans

WAY = "[{at_s: 0, values: {x_c: 0, z_c: 3}}, {at_s: %g, values: {x_c: %g}}, {at_s: %g, values: {x_c: 0}}]"


def pair(plan: str, **drone: Any) -> Scenario:
    drones = [{"name": f"d{k}", "position_m": [0, 2 - 4 * k, 0], **drone} for k in range(2)]
    cluster = {"name": "main", "drones": ["d0", "d1"], "plan": yaml.safe_load(plan)}
    document = {"name": "t", "duration_s": 60, "drones": drones, "sensors": {"preset": "paper"}, "clusters": [cluster]}
    return scenario_file.resolve(document)


def way(m: float, half_s: float, start_s: float = 20) -> str:
    return f"{{takeoff_s: 2, trajectory: {{start_s: {start_s}, waypoints: {WAY % (half_s, m, 2 * half_s)}}}}}"


def refusal(scenario: Scenario) -> str:
    try:
        check_plan(scenario, scenario.clusters[0])
    except RunError as error:
        return str(error)
    return ""


def factor(text: str) -> float:
    return float(re.findall(r"stretch its times by ([\d.]+)", text)[0])


@pytest.mark.parametrize("path", sorted(SCENARIOS.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_provided_scenarios_can_be_flown(path: Path) -> None:
    scenario = scenario_file.load(path)
    assert [refusal(scenario)] * len(scenario.clusters) == [""] * len(scenario.clusters)
    for cluster in scenario.clusters:
        check_plan(scenario, cluster)


def test_a_trajectory_that_is_too_fast_is_refused_with_the_factor() -> None:
    """A cubic from rest to rest over 30 m in 10 s peaks at 1.5 × 3 m/s, three times the 1.5 m/s of the gains."""
    text = refusal(pair(way(30, 10)))
    assert has_terms(text, "clusters[0].plan.trajectory", "3.00", "0.8")
    assert factor(text) == pytest.approx(3.0 / 0.8, rel=0.01)
    assert refusal(pair(way(30, 10 * factor(text)))) == ""
    assert refusal(pair(way(30, 10 * factor(text) / 1.2))) != ""
    assert refusal(pair(way(7, 10))) == ""
    slow = pair(way(7, 10), limits={"horizontal_speed_m_s": 0.5})  # slower than its controller commands
    assert factor(refusal(slow)) == pytest.approx(1.5 * 0.7 / 0.5 / 0.8, rel=0.01)


def test_a_plan_is_not_judged_if_the_formation_is_singular(monkeypatch: pytest.MonkeyPatch) -> None:
    def condition(self: ClusterSpace, c: Array) -> float:
        raise SingularClusterError("in line")

    monkeypatch.setattr(ClusterSpace, "condition", condition)
    assert refusal(pair(way(30, 10))) == ""


def test_an_expression_is_judged_over_its_duration() -> None:
    turns = "{{takeoff_s: 2, trajectory: {{start_s: 20, expressions: {{x_c: 0, y_c: 0, z_c: 3, yaw: {}*t}}}}}}"
    assert refusal(pair(turns.format(0.1))) == ""
    assert refusal(pair(way(30, 10).replace("takeoff_s: 2, ", ""))) == ""  # without a take-off it is not judged
    assert factor(refusal(pair(turns.format(2)))) > 1.0


def test_a_step_that_ends_before_it_can_begin_is_refused_with_a_time() -> None:
    assert has_terms(refusal(pair(way(1, 1, start_s=1))), "clusters[0].plan.trajectory", "3 s", "5 s")
    far = "{takeoff_s: 2, trajectory: {start_s: 10, waypoints: [{at_s: 0, values: {x_c: 90}}, {at_s: 9, values: {x_c: 92}}]}}"
    assert has_terms(text := refusal(pair(far)), "clusters[0].plan.trajectory", "19 s")
    least_s = 5 + 15 / 8 * 90 / (0.8 * 1.5)
    assert least_s - 1 < float(re.findall(r"before (\d+) s", text)[0]) < 1.2 * least_s
    landing = "{takeoff_s: 2, land_s: 15, trajectory: {start_s: 20, expressions: {x_c: 0.1*t}}}"
    assert has_terms(refusal(pair(landing)), "clusters[0].plan.land_s", "15", "20 s")
    assert refusal(pair("{takeoff_s: 2, target: {x_c: 1}, land_s: 3}")).startswith("clusters[0].plan.land_s")


def test_a_target_too_far_for_its_time_is_refused_with_a_feasible_time() -> None:
    """A quintic from rest to rest peaks at 15/8 of its mean speed."""
    text = refusal(pair("{takeoff_s: 2, target: {x_c: 30}, target_over_s: 10}"))
    least_s = 15 / 8 * 30 / (0.8 * 1.5)
    assert has_terms(text, "clusters[0].plan.target_over_s", "10", f"{least_s / 10:.2g} times", f"{least_s:.1f} s")
    assert refusal(pair(f"{{takeoff_s: 2, target: {{x_c: 30}}, target_over_s: {least_s + 0.1:g}}}")) == ""
    assert refusal(pair("{takeoff_s: 2, target: {x_c: 30}}")) == ""


@pytest.mark.parametrize(
    ("target", "terms"),
    [
        ("{z_c: 0.1}", ("0.10 m", "0.5 m")),
        ("{p: 1.5}", ("1.500 m", "2 m")),
        ("{z_c: 150}", ("d0", "150.0 m", "100 m")),
        ("{pitch: 1.2}", ("pitch", "68.8 deg", "30 deg")),
    ],
)
def test_an_invalid_formation_is_refused_in_target_and_trajectory(target: str, terms: tuple[str, ...]) -> None:
    text = refusal(pair(f"{{takeoff_s: 2, target: {target}}}"))
    assert text.startswith("clusters[0].plan.target: ")
    trajectory = f"{{takeoff_s: 2, trajectory: {{start_s: 400, waypoints: [{{at_s: 0, values: {target}}}]}}}}"
    other = refusal(pair(trajectory))
    assert other.startswith("clusters[0].plan.trajectory: ")
    for each in (text, other):
        assert has_terms(each, *terms)
