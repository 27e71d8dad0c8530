"""A cluster's law reads only what the scenario grants it; processes, a hosted run and a rerun give the same bits."""

from pathlib import Path
from typing import Any

import pytest
from forked_commands import run_here
from refused import has_terms

import zsim
from zsim.contract import keys, messages
from zsim.errors import RunError, ScenarioError, UserCodeError
from zsim.scenario import scenario_file
from zsim.scenario.roles import permits, rights_for
from zsim_agents.formation.engagement_setup import engagement_of
from zsim_world.run.world import World

EXAMPLES = Path(__file__).parents[2] / "examples"
WALL = EXAMPLES / "wall.yaml"
FLOWN_S = 16

LAWS = """
import zsim
from zsim.sensors.scanner import Lidar, Range


class Seeing(zsim.ControlLaw):
    def __init__(self, space, gains=None):
        super().__init__(space, gains)
        self.walls = [each.name for each in self.map.obstacles]

    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        self.seen = self.samples("range", Range)
        return 0 * c


class Blind(zsim.ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return 0 * c


class Misled(Seeing):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        self.samples("range", Lidar)
        return 0 * c
"""


@pytest.fixture(autouse=True)
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "seeing.py").write_text(LAWS)
    monkeypatch.syspath_prepend(str(tmp_path))


def test_the_formation_stops_at_a_wall_with_the_same_bits_after_a_kill(tmp_path: Path, forked: None) -> None:
    """The law keeps 2 m from what the beams hit, with noise and bias of 1 cm each; the target is behind the wall."""
    alone = zsim.run(WALL, duration_s=FLOWN_S, out=tmp_path / "alone", progress=False)
    assert 1.8 < min(alone.summary.obstacle_distance_m.values()) < 2.2
    with zsim.Federation(WALL, duration=FLOWN_S, out=tmp_path / "many") as flight:
        flight.wait_until(12.5)
        flight.kill("controller.main")
        run = flight.run()
    assert "controller.main" in [*run.events[run.events.kind == "restart"].subject]
    assert run.truth_sha256 == alone.truth_sha256
    again = run_here("rerun", str(tmp_path / "many"), "--trust")
    assert again.code == 0, again
    assert alone.truth_sha256 in again.stdout + again.stderr


@pytest.mark.soak
def test_a_hosted_run_gives_the_same_bits(tmp_path: Path, forked: None) -> None:
    alone = zsim.run(WALL, duration_s=FLOWN_S, out=tmp_path / "alone", progress=False)
    hosted = zsim.run(WALL, duration_s=FLOWN_S, out=tmp_path / "hosted", processes=True, options=["--hosted"])
    assert hosted.truth_sha256 == alone.truth_sha256


def cluster(*overrides: str, **fields: Any) -> Any:
    given = {"law": "seeing:Seeing", "law_sensors": ["range"], "law_map": True} | fields
    return scenario_file.load(WALL, [*overrides, *(f"clusters.main.{name}={each}" for name, each in given.items())])


def test_grants_are_in_place_before_the_first_sample() -> None:
    scenario = cluster()
    law: Any = engagement_of(scenario, scenario.clusters[0]).law
    assert law.walls == ["wall"]
    law.rates(*[law.space.specimen(5.0)] * 5)
    assert law.seen == (None, None, None)
    rights = rights_for("controller.main", scenario)
    assert permits(rights.reads, keys.sensor("drone2", "range"))
    assert not permits(rights.reads, keys.sensor("drone2", "gps"))


def test_samples_of_a_user_s_sensor_have_the_user_s_class() -> None:
    """Samples are decoded into a class built from the sensor's declaration; a law asks for the user's own class."""
    from uwb_range import UwbRange  # type: ignore[import-not-found]

    scenario = cluster("sensors.uwb={module: uwb_range}", law="seeing:Blind", law_sensors=["uwb"])
    World(scenario).info()
    law: Any = engagement_of(scenario, scenario.clusters[0]).law
    key = keys.sensor("drone2", "uwb")
    sample = UwbRange(t_ns=20_000_000, seq=0, t_sample_ns=10_000_000, range_m=3.0)
    law.grants.put(key, messages.decode(key, messages.encode(sample)))
    none, seen, _ = law.samples("uwb", UwbRange)
    assert none is None
    assert type(seen) is UwbRange
    assert (seen.range_m, seen.t_ns, seen.t_sample_ns) == (3.0, 20_000_000, 10_000_000)


@pytest.mark.parametrize(
    ("fields", "terms"),
    [
        ({"law_map": False}, ("seeing:Seeing", "clusters.main.law_map", "law_map: true")),
        ({"law_sensors": ["gps"]}, ("seeing:Seeing", "clusters.main.law_sensors", "[gps, range]")),
        ({"law": "seeing:Misled"}, ("seeing:Misled", "'range'", "Lidar", "Range")),
    ],
)
def test_reading_without_a_grant_or_as_another_class_is_refused(fields: Any, terms: tuple[str, ...]) -> None:
    scenario = cluster(**fields)
    with pytest.raises(RunError) as raised:
        engagement_of(scenario, scenario.clusters[0])
    assert isinstance(raised.value, UserCodeError)
    assert has_terms(str(raised.value), *terms), str(raised.value)


@pytest.mark.parametrize(
    ("fields", "path"),
    [
        ({"law": "proportional", "law_map": "false"}, "clusters[0].law_sensors"),
        ({"law": "proportional", "law_sensors": []}, "clusters[0].law_map"),
        ({"law_sensors": ["range", "lidar"]}, "clusters[0].law_sensors[1]"),
        ({"law_sensors": ["range", "range"]}, "clusters[0].law_sensors[1]"),
        ({"law_sensors": ["Range"]}, "clusters[0].law_sensors[0]"),
        ({"law_sensors": "range"}, "clusters[0].law_sensors"),
        ({"law_map": "maybe"}, "clusters[0].law_map"),
    ],
)
def test_an_unusable_grant_is_refused(fields: Any, path: str) -> None:
    with pytest.raises(ScenarioError) as raised:
        cluster(**fields)
    assert [line.split(" ")[1] for line in raised.value.faults] == [path]
