"""Agents of a user's class, one per drone, exchange their positions: the bits are the same however they are run."""

from itertools import pairwise, permutations
from pathlib import Path
from typing import Any

import pytest
import yaml
from federation import Federation

import zsim
from zsim.contract.keys import RADIO
from zsim.contract.messages import decode
from zsim.errors import UserCodeError
from zsim.record import RecordReader
from zsim.runtime.bus import Bus
from zsim.scenario import scenario_file
from zsim_agents.hosting import hosted
from zsim_analysis.in_process import fly
from zsim_analysis.rerun import rerun_record
from zsim_world.run.world import World

EXAMPLES = Path(__file__).parents[2] / "examples"
GATE_S = 0.02
SWARM = """
name: swarm
duration_s: 6
drones:
  - {name: d1, position_m: [0, 0, 0]}
  - {name: d2, position_m: [6, 0, 0]}
  - {name: d3, position_m: [0, 6, 0]}
agents: {pilot: {class: 'swarm:Pilot', parameters: {takeoff_s: 0.5}}}
"""
OVER_RADIO = """
topology: {nearest: 1, symmetric: true}
radio:
  {range_m: 6, spread_m: 0.5, loss: 0.3, delay_ms: 30, jitter_ms: 40, bandwidth_kbit_s: 16, line_of_sight: true}
environment: {surfaces: [{name: ridge, file: ridge.csv, cell_m: 1, position_m: [3, 0, 0]}]}
"""
RIDGE = "0,9,0\n" * 5  # between d1 and d2, from x = 2 to 4 m and y = -2 to 2 m
TALKERS = """
import zsim


class Word(zsim.AgentMessage, frozen=True):
    key = "talk/{drone}/word"
    said: float


class Talker(zsim.Agent):
    messages = (Word,)
    reads = (Word.of(),)

    def __init__(self, drone):
        super().__init__()
        self.drone, self.heard, self.new = drone, [], []

    def receive(self, key, message):
        if key.startswith("talk/"):
            self.new.append((key.split("/")[1], message.t_ns))

    def step(self, t_ns):
        self.heard += [[t_ns, *each] for each in self.new]
        self.new = []
        return [self.message(t_ns, Word(said=self.said(t_ns)))]

    def said(self, t_ns):
        return t_ns / 1e9


class Nan(Talker):
    def said(self, t_ns):
        return float("nan") if t_ns > 300_000_000 else 0.0


class Shape(Talker):
    def said(self, t_ns):
        return (1.0, 2.0)


class Bare(Talker):  # the message itself, in place of an output of it
    def step(self, t_ns):
        return [Word(said=0.0)]


class Nothing(Talker):
    def step(self, t_ns):
        super().step(t_ns)


class Number(Talker):
    def step(self, t_ns):
        return [t_ns]


class Unlisted(Talker):
    messages = ()

    def step(self, t_ns):
        return [Word(said=0.0)]


class BySource(Talker):
    def receive(self, key, message):
        if key.startswith("talk/"):
            self.new.append((message.source, message.t_ns))


class Foreign(Talker):
    def step(self, t_ns):
        return [zsim.Output(Word.of("d2"), Word(t_ns=t_ns, seq=0, said=0.0))] if self.drone == "d1" else []


class Pirate(Talker):
    def step(self, t_ns):
        return [self.command(t_ns, "d2", zsim.takeoff())] if self.drone == "d1" else []
"""
TALK = """
name: talk
duration_s: 0.5
drones: [{name: d1, position_m: [0, 0, 0]}, {name: d2, position_m: [6, 0, 0]}, {name: d3, position_m: [0, 6, 0]}]
agents: {talk: {class: 'talkers:%s'}}
"""
NAMES = ("talk.d1", "talk.d2", "talk.d3")


@pytest.fixture(autouse=True)
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "talkers.py").write_text(TALKERS)
    for folder in (EXAMPLES, tmp_path):
        monkeypatch.syspath_prepend(str(folder))


def heard(groups: list[list[str]], gates_max: int, kind: str = "Talker", **more: Any) -> dict[str, list[Any]]:
    """Return what each agent hears in one process, in these groups of agents; `more` are fields of the scenario."""
    scenario = scenario_file.resolve({**_talk(kind), "processes": {"expect": list(NAMES)}, **more})
    world = World(scenario)
    agents = [hosted(world.info(), scenario, group) for group in groups]
    bus = Bus(world, agents, lambda: 0)
    bus.join()
    while bus.turn(gates_max):
        pass
    bus.end()
    members = [each for agent in agents for each in getattr(agent, "_members", [agent])]
    return {each.name: each.heard for each in members}


def _talk(kind: str) -> dict[str, Any]:
    return yaml.safe_load(TALK % kind)


@pytest.mark.parametrize("gates_max", [1, 10])
def test_agents_hear_all_messages_one_gate_later_in_any_order(gates_max: int) -> None:
    gates = [round(gate * GATE_S * 1e9) for gate in range(26)]
    wanted = [[at, drone, sent] for sent, at in pairwise(gates) for drone in ("d1", "d2", "d3")]
    for order in permutations(NAMES):
        assert heard([[name] for name in order], gates_max) == dict.fromkeys(NAMES, wanted)
        assert heard([[*order]], gates_max) == dict.fromkeys(NAMES, wanted)
        assert heard([[*order[:2]], [order[2]]], gates_max) == dict.fromkeys(NAMES, wanted)


def test_the_source_of_a_message_is_its_agent_in_any_grouping(tmp_path: Path) -> None:
    apart = heard([[name] for name in NAMES], 1, kind="BySource")
    assert {source for _, source, _ in apart["talk.d2"]} == {*NAMES}
    assert heard([[*NAMES]], 1, kind="BySource") == apart


def test_a_step_may_return_a_message_in_place_of_an_output(tmp_path: Path) -> None:
    fly(scenario_file.resolve(_talk("Bare")), tmp_path / "run.mcap")
    with RecordReader(tmp_path / "run.mcap") as reader:
        sent = [decode(each.key, each.payload) for each in reader.messages(["talk/d3/word"])]
    assert [(each.seq, each.source) for each in sent] == [(seq, "talk.d3") for seq in range(26)]


@pytest.mark.parametrize("groups", [[["talk.d1"], ["talk.d2"], ["talk.d3"]], [[*NAMES]]], ids=["apart", "together"])
def test_the_link_between_two_agents_can_be_cut(groups: list[list[str]]) -> None:
    cut = {"kind": "link_cut", "target": "talk.d1/talk.d2", "one_way": True, "at_s": 0.1, "for_s": 0.2}
    whole, lacking = heard(groups, 1), heard(groups, 1, faults=[cut])
    lost = [entry for entry in whole["talk.d2"] if entry not in lacking["talk.d2"]]
    assert {drone for _, drone, _ in lost} == {"d1"}
    assert len(lost) == 10  # gates in 0.2 s
    assert (whole["talk.d1"], whole["talk.d3"]) == (lacking["talk.d1"], lacking["talk.d3"])


@pytest.mark.parametrize("groups", [[["talk.d1"], ["talk.d2"], ["talk.d3"]], [[*NAMES]]], ids=["apart", "together"])
def test_a_radio_fault_loses_messages_by_distance(groups: list[list[str]]) -> None:
    """From 0.1 s to 0.3 s, d2 and d3, which are 8.5 m apart, hardly hear each other; d1 is 6 m from both."""
    fault = {"kind": "radio", "target": "world", "range_m": 6, "spread_m": 0.2, "at_s": 0.1, "for_s": 0.2}
    whole, lacking = heard(groups, 1), heard(groups, 1, faults=[fault])
    for name in NAMES:
        lost = [entry for entry in whole[name] if entry not in lacking[name]]
        gates = {drone: [sent // 20_000_000 for _, each, sent in lost if each == drone] for drone in ("d1", "d2", "d3")}
        assert gates.pop(name[-2:]) == []
        near, far = (
            (gates["d1"], gates["d3" if name == "talk.d2" else "d2"]) if name != "talk.d1" else (gates["d2"], [])
        )
        assert 0 < len(near) < 10
        assert {*near, *far} <= {*range(6, 16)}
        assert len(far) == (0 if name == "talk.d1" else 10)


@pytest.mark.parametrize(
    ("kind", "terms"),
    [
        ("Nan", ("talk.d1 at 0.32 s", "talkers:Nan.step", "talk/d1/word", "said", "nan")),
        ("Shape", ("talk.d1 at 0.00 s", "talkers:Shape.step", "talk/d1/word", "said", "[1.0, 2.0]")),
        ("Nothing", ("talk.d1 at 0.00 s", "talkers:Nothing.step", "null")),
        ("Number", ("talk.d1 at 0.00 s", "talkers:Number.step", "0")),
        ("Unlisted", ("talk.d1 at 0.00 s", "talkers:Unlisted.step", "talk/d1/word", "Word", "messages")),
        ("Foreign", ("talk.d1 at 0.00 s", "talkers:Foreign.step", "talk/d2/word", "talk/d1/word")),
        ("Pirate", ("talk.d1 at 0.00 s", "talkers:Pirate.step", "drone/d2/cmd/mode", "d1")),
    ],
)
def test_an_invalid_output_ends_the_run_naming_its_class_and_gate(
    kind: str, terms: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(UserCodeError) as raised:
        fly(scenario_file.resolve(_talk(kind)), tmp_path / "run.mcap")
    assert all(term in str(raised.value) for term in terms), raised.value


@pytest.mark.parametrize("groups", [[["talk.d1"], ["talk.d2"], ["talk.d3"]], [[*NAMES]]], ids=["apart", "together"])
def test_the_radio_respects_range_delay_topology_and_bandwidth(groups: list[list[str]]) -> None:
    """d2 and d3 are 8.5 m apart, and d1 is 6 m from both."""
    near = heard(groups, 1, radio={"range_m": 7})
    assert [{drone for _, drone, _ in near[name]} for name in NAMES] == [{"d1", "d2", "d3"}, {"d1", "d2"}, {"d1", "d3"}]
    assert {at - sent for each in near.values() for at, _, sent in each} == {20_000_000}
    late = heard(groups, 1, radio={"delay_ms": 50}, topology={"d2": ["d3"]})
    assert {(drone, at - sent) for at, drone, sent in late["talk.d2"]} == {("d2", 20_000_000), ("d3", 60_000_000)}
    assert {drone for _, drone, _ in late["talk.d1"]} == {"d1"}
    slow = heard(groups, 1, radio={"bandwidth_kbit_s": 5, "queue_max": 1})  # 26 bytes take 41.6 ms
    assert [at // 20_000_000 for at, drone, _ in slow["talk.d2"] if drone == "d2"] == [
        1,
        3,
        5,
        7,
        9,
        11,
        13,
        15,
        17,
        19,
        21,
        23,
        25,
    ]


def test_processes_and_a_rerun_give_the_same_bits(tmp_path: Path, forked: None) -> None:
    """The radio loses and delays messages, a ridge parts two drones, and a killed pilot resumes from its snapshot."""
    (tmp_path / "ridge.csv").write_text(RIDGE)
    (tmp_path / "swarm.yaml").write_text(SWARM + OVER_RADIO)
    alone = zsim.run(tmp_path / "swarm.yaml", out=tmp_path / "alone", progress=False)
    messages = alone.messages("swarm/d1/position")
    assert 150 < len(messages) < 301  # as many as the bandwidth allows
    with RecordReader(tmp_path / "alone" / "run.mcap") as reader:
        d1_hears = {decode(each.key, each.payload).hears[0] for each in reader.messages([RADIO])}
    assert d1_hears == {(2,)}  # d3; d2 is as near, but behind the ridge
    assert {"position_m_x", "position_m_y", "position_m_z"} <= {*messages.columns}
    with zsim.Federation(tmp_path / "swarm.yaml", out=tmp_path / "many") as flight:
        flight.wait_until(3.0)
        flight.kill("pilot.d2")
        run = flight.run()
    assert run.truth_sha256 == alone.truth_sha256
    assert "pilot.d2" in [*run.events[run.events.kind == "restart"].subject]
    said: list[str] = []
    assert rerun_record(tmp_path / "alone", False, said.append, said.append) == ""
    with RecordReader(tmp_path / "many" / "run.mcap") as reader:
        assert "swarm/d3/position" in reader.topics()


@pytest.mark.soak
def test_hosted_agents_give_the_same_bits(
    federation: Federation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES))
    (tmp_path / "swarm.yaml").write_text(SWARM)
    alone = zsim.run(tmp_path / "swarm.yaml", out=tmp_path / "alone", progress=False)
    federation.run(SWARM, "--hosted").ends(with_code=0)
    assert federation.record().sha256() == alone.truth_sha256


def test_the_swarm_forms_a_regular_pentagon(tmp_path: Path) -> None:
    """Consensus on displacements over a radio of 8 m range that loses 30 %; the last positions heard are held."""
    run = zsim.run(EXAMPLES / "swarm.yaml", duration_s=25, out=tmp_path / "run", progress=False)
    places = {drone: run.estimate(drone).iloc[-1] for drone in run.drones}
    sides = []
    for i in range(5):
        one, other = places[f"drone{i + 1}"], places[f"drone{(i + 1) % 5 + 1}"]
        d2 = sum((one[f"position_m_{axis}"] - other[f"position_m_{axis}"]) ** 2 for axis in "xy")
        sides.append(d2**0.5)
    assert sides == pytest.approx([3.5267] * 5, abs=0.3)  # 2 · 3 m · sin(36°)


def test_agent_parameters_are_swept_by_path(near: None, tmp_path: Path) -> None:
    """In one of the runs, the take-off would come after the end."""
    path = "agents.pilot.parameters.takeoff_s"
    (tmp_path / "swarm.yaml").write_text(SWARM)
    frame = zsim.sweep(
        tmp_path / "swarm.yaml", {path: [0.5, 9.0]}, metrics=climbs, duration_s=4, workers=1, progress=False
    )
    assert [*frame[path]] == [0.5, 9.0]
    assert [*(frame["metrics.climb_m"] > 0.5)] == [True, False]


def climbs(run: zsim.Run) -> dict[str, float]:
    return {"climb_m": run.truth("d1").position_m_z.max()}
