"""Users' agent and law classes in a scenario: what is filled in, and which faults are reported where."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from refused import faults_of, has_terms

from zsim.contract import keys
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.roles import agent_names, expected_processes, permits, rights_for
from zsim.schema import plugin
from zsim_agents.formation.engagement_setup import engagement_of

MODULE = """
from typing import Annotated

import zsim
from msgspec import Meta


class Offset(zsim.AgentMessage, frozen=True):
    key = "swarm/{drone}/offset"
    offset_m: tuple[float, float, float]
    samples: list[float]
    leads: bool = False
    note: str = ""
    count: int = 0


class OfTheRun(zsim.AgentMessage, frozen=True):
    key = "swarm/{run}/plan"
    at_s: float


class Complex(zsim.AgentMessage, frozen=True):
    key = "swarm/{drone}/complex"
    value: complex


class Elsewhere(zsim.AgentMessage, frozen=True):
    key = "drone/{drone}/offset"
    at_s: float


class Agent(zsim.Agent):
    def receive(self, key, message): ...
    def step(self, t_ns): return []


class Pilot(Agent):
    class Parameters(zsim.Parameters):
        height_m: float
        push_1_s: Annotated[float, Meta(ge=0, le=2)] = 0.4

    messages = (Offset,)


class Watch(Agent):
    messages = (OfTheRun,)

    def __init__(self, scenario, radius_m: float = 3.0, drone: str = ""): ...


class OtherPilot(Pilot):
    class Parameters(zsim.Parameters):
        pass


class OfComplex(Agent):
    messages = (Complex,)


class OfElsewhere(Agent):
    messages = (Elsewhere,)


class NoAgent:
    pass


class Law(zsim.ControlLaw):
    class Parameters(zsim.Parameters):
        push_1_s: Annotated[float, Meta(ge=0, le=2)] = 0.4

    def __init__(self, space, gains=None):
        super().__init__(space, gains)
        self.doubled = 2 * self.parameters.push_1_s

    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return 0 * c


class Plain(Law):
    Parameters = None
"""
BASE: dict[str, Any] = {
    "name": "s",
    "duration_s": 1,
    "drones": [{"name": "d1", "position_m": [0, 0, 0]}, {"name": "d2", "position_m": [4, 0, 0]}],
}
PILOT = {"class": "flyers:Pilot", "parameters": {"height_m": 2}}


@pytest.fixture(autouse=True)
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "flyers.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))


def resolve(**agents: Any) -> Any:
    return scenario_file.resolve({**BASE, "agents": agents})


def test_resolved_parameters_and_messages_are_read_without_the_module() -> None:
    scenario = resolve(pilot=PILOT, watch={"class": "flyers:Watch", "per": "run"})
    pilot, watch = scenario.own_agents["pilot"], scenario.own_agents["watch"]
    assert pilot.parameters == {"push_1_s": 0.4, "height_m": 2.0}
    assert watch.parameters == {"radius_m": 3.0}
    offset, plan = scenario.own_messages()
    assert (offset.key, offset.message) == ("swarm/*/offset", "Offset")
    types = {"offset_m": "number[3]", "samples": "number[]", "leads": "flag", "note": "text", "count": "whole"}
    assert offset.fields == types
    assert plan.key == "swarm/*/plan"
    text = scenario_file.to_text(scenario)
    with plugin.names_only():
        assert scenario_file.from_text(text) == scenario
    assert yaml.safe_load(text)["agents"]["pilot"]["class"] == "flyers:Pilot"


def test_user_agents_are_processes_like_the_stock_ones() -> None:
    scenario = resolve(pilot=PILOT, watch={"class": "flyers:Watch", "per": "run"})
    own = ["pilot.d1", "pilot.d2", "watch.main"]
    assert agent_names(scenario) == expected_processes(scenario) == ["estimator.d1", "estimator.d2", *own]
    assert scenario.own_code() == ["flyers:Pilot", "flyers:Watch"]


def test_user_agents_write_only_for_their_drone_and_read_all_but_the_truth() -> None:
    scenario = resolve(pilot=PILOT, watch={"class": "flyers:Watch", "per": "run"})
    pilot, watch = rights_for("pilot.d1", scenario), rights_for("watch.main", scenario)
    assert permits(pilot.writes, "swarm/d1/offset")
    assert not permits(pilot.writes, "swarm/d2/offset")
    assert permits(pilot.writes, keys.command("d1", "velocity"))
    assert not permits(pilot.writes, keys.command("d2", "velocity"))
    assert permits(watch.writes, keys.command("d2", "mode"))
    assert permits(watch.writes, "swarm/main/plan")
    for rights in (pilot, watch):
        for key in ("swarm/d2/offset", "swarm/main/plan", keys.estimate("d2"), keys.sensor("d2", "imu")):
            assert permits(rights.reads, key), key
        assert not permits(rights.reads, keys.truth("d1"))


@pytest.mark.parametrize(
    ("agents", "terms"),
    [
        ({"pilot": {"class": "flyers:Pilot"}}, ("agents.pilot.parameters.height_m", "missing")),
        (
            {"pilot": {**PILOT, "parameters": {"height_m": 2, "push_1_s": 3}}},
            ("agents.pilot.parameters.push_1_s", "3", "0", "2"),
        ),
        (
            {"pilot": {**PILOT, "parameters": {"height_m": 2, "pusch_1_s": 1}}},
            ("agents.pilot.parameters.pusch_1_s", "push_1_s"),
        ),
        ({"pilot": {**PILOT, "per": "run"}}, ("agents.pilot.per", "'run'", "Offset", "swarm/{drone}/offset")),
        ({"watch": {"class": "flyers:Agent", "per": "cluster"}}, ("agents.watch.per", "'cluster'", "drone", "run")),
        ({"estimator": PILOT}, ("agents.estimator", "estimator", "controller")),
        ({"operator": {"class": "flyers:Agent"}}, ("agents.operator", "operator")),
        ({"Pilot": PILOT}, ("agents.Pilot",)),
        ({"a": {"class": "flyers:Nobody"}}, ("agents.a.class", "'flyers:Nobody'", "Pilot")),
        ({"a": {"class": "nowhere:Pilot"}}, ("agents.a.class", "'nowhere:Pilot'", "'nowhere'")),
        ({"a": {"class": "flyers"}}, ("agents.a.class", "'flyers'", "package.module:Class")),
        (
            {"a": {"class": "flyers:NoAgent"}},
            ("agents.a.class", "'flyers:NoAgent'", "receive", "step()", "Agent"),
        ),
        ({"a": {"class": "flyers:OfComplex"}}, ("agents.a.class", "Complex.value", "number", "text")),
        (
            {"a": {"class": "flyers:OfElsewhere"}},
            ("agents.a.class", "Elsewhere.key", "'drone/{drone}/offset'", "swarm…"),
        ),
        ({"a": PILOT, "b": {"class": "flyers:OtherPilot"}}, ("agents.b.class", "swarm/*/offset", "agents.a")),
    ],
)
def test_invalid_agents_are_reported_with_their_path(agents: dict[str, Any], terms: tuple[str, ...]) -> None:
    (line,) = faults_of({**BASE, "agents": agents})
    assert has_terms(line, *terms), line


def test_an_unresolved_agent_in_world_info_is_refused() -> None:
    with pytest.raises(ScenarioError) as raised:
        scenario_file.from_text(yaml.safe_dump({**BASE, "agents": {"pilot": PILOT}}))
    assert has_terms(str(raised.value), "agents.pilot.declared")


def of_law(**cluster: Any) -> Any:
    return scenario_file.resolve({**BASE, "clusters": [{"name": "main", "drones": ["d1", "d2"], **cluster}]})


def test_law_parameters_are_filled_in_overridden_and_passed_to_the_law(tmp_path: Path) -> None:
    scenario = of_law(law="flyers:Law")
    assert scenario.cluster("main").law_parameters == {"push_1_s": 0.4}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump({**BASE, "clusters": [{"name": "main", "drones": ["d1", "d2"]}]}))
    overrides = ["clusters.main.law=flyers:Law", "clusters.main.law_parameters.push_1_s=1.5"]
    scenario = scenario_file.load(tmp_path / "s.yaml", overrides)
    law = engagement_of(scenario, scenario.cluster("main")).law
    assert (law.parameters.push_1_s, law.doubled) == (1.5, 3.0)  # type: ignore[attr-defined]
    with plugin.names_only():
        assert scenario_file.from_text(scenario_file.to_text(scenario)) == scenario


@pytest.mark.parametrize(
    ("cluster", "terms"),
    [
        (
            {"law": "flyers:Law", "law_parameters": {"push_1_s": 3}},
            ("clusters[0].law_parameters.push_1_s", "3", "0", "2"),
        ),
        (
            {"law": "flyers:Law", "law_parameters": {"push": 1}},
            ("clusters[0].law_parameters.push", "push_1_s", "'main'"),
        ),
        ({"law": "flyers:Plain", "law_parameters": {"push": 1}}, ("clusters[0].law_parameters", "Plain", "Parameters")),
    ],
)
def test_invalid_law_parameters_are_reported_with_the_scenario(cluster: dict[str, Any], terms: tuple[str, ...]) -> None:
    with pytest.raises(ScenarioError) as raised:
        of_law(**cluster)
    assert has_terms(str(raised.value), *terms), str(raised.value)
