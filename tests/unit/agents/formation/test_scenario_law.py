"""The control law that a scenario asks for, and what every law shares."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refused import refused

from zsim.errors import RunError, ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.control_law import ControlLaw, ProportionalLaw
from zsim_agents.formation.engagement_setup import engagement_of
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.spaces.triad_cluster import TriadCluster

STEP = Path(__file__).parents[4] / "scenarios" / "step.yaml"
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
    def __init__(self, n):
        super().__init__(n)
        self.places = None

    @classmethod
    def for_places(cls, places_m):
        made = cls(len(places_m))
        made.places = places_m
        return made
"""


class Rates(ControlLaw):
    """Asks for what a test says, and counts how often it is followed."""

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
    return scenario_file.load(STEP, [f"clusters.main.{field}={value}" for field, value in cluster.items()])


def test_a_law_of_the_user_s_own_flies(module: str) -> None:
    made = scenario(law=f"{module}:Still")
    law = engagement_of(made, made.clusters[0]).law
    assert type(law).__name__ == "Still"
    assert law.gains.k_1_s == made.clusters[0].gains.proportional_1_s


def test_without_a_name_the_stock_law_flies_and_the_text_stays() -> None:
    plain, named = scenario(), scenario(law="proportional")
    for made in (plain, named):
        assert type(engagement_of(made, made.clusters[0]).law) is ProportionalLaw
    assert "law" not in scenario_file.to_text(plain)
    assert scenario_file.from_text(scenario_file.to_text(named)).clusters[0].law == "proportional"


def test_a_space_of_the_user_s_own_gets_the_places_of_its_robots(module: str) -> None:
    made = scenario(space=f"{module}:Named", template_m="[[1, 0, 0], [0, 1, 0], [0, -1, 0]]")
    space: Any = engagement_of(made, made.clusters[0]).space
    assert space.places.tolist() == [[1, 0, 0], [0, 1, 0], [0, -1, 0]]


@pytest.mark.parametrize(
    ("field", "name", "terms"),
    [
        ("law", "nowhere:Law", ("ModuleNotFoundError",)),
        ("law", "formation_of_mine:Other", ("Half", "Lost", "Named", "Nothing", "Raises", "Short", "Still")),
        ("law", "formation_of_mine:Half", ("rates()",)),
        ("law", "formation_of_mine:Short", ("(3,)",)),
        ("law", "formation_of_mine:Lost", ("formation_of_mine:Lost.rates", "nan", "vz", "robot", "2")),
        ("law", "formation_of_mine:Nothing", ("formation_of_mine:Nothing.rates", "null", "12")),
        (
            "law",
            "formation_of_mine:Raises",
            ("formation_of_mine:Raises.rates", "ZeroDivisionError", "formation_of_mine.py:29"),
        ),
        ("space", "formation_of_mine:Flat", ("formation_of_mine:Flat.forward", "(3,)", "(12,)")),
        ("space", "formation_of_mine:Lame", ("formation_of_mine:Lame.motion", "inf", "2")),
        ("space", "formation_of_mine:Still", ("forward",)),
        ("space", "nowhere:Space", ("ModuleNotFoundError",)),
    ],
)
def test_what_cannot_be_flown_is_one_line(module: str, field: str, name: str, terms: tuple[str, ...]) -> None:
    made = scenario(**{field: name})
    with pytest.raises(RunError) as raised:
        engagement_of(made, made.clusters[0])
    line = str(raised.value)
    assert line.startswith("cluster 'main'")
    assert all(term in line for term in terms), line
    assert "\n" not in line


@pytest.mark.parametrize(("field", "stock"), [("space", "triad, template"), ("law", "proportional")])
def test_a_name_that_is_none_is_a_fault_of_the_scenario(field: str, stock: str) -> None:
    with pytest.raises(ScenarioError) as raised:
        scenario(**{field: "tirad"})
    (line,) = raised.value.faults
    assert f"clusters[0].{field} is 'tirad'" in line
    assert stock in line
    assert "(cluster 'main')" in line


@pytest.mark.parametrize(("speed_m_s", "followed_s"), [(0.1, 0.02), (100.0, 0.0)])
def test_every_law_is_saturated_and_knows_when_it_is_followed(speed_m_s: float, followed_s: float) -> None:
    space = cluster_space(3)
    law = Rates(space, np.tile([speed_m_s, 0.0, 0.0, 0.0], 3))
    c = space.specimen(5.0)
    p_W, _ = space.inverse(c)
    command = law.command(c, p_W, np.zeros((3, 3)), c, np.zeros(12), 0.02)
    assert law.followed_s == followed_s
    assert command.v_W[:, 0] == pytest.approx(min(speed_m_s, law.gains.speed_max_m_s))


def test_a_space_without_the_names_that_it_needs_is_refused() -> None:
    with refused(ValueError, "11", "2"):
        TriadCluster(2)
