"""Faults during a run: added, begun, ended, cleared, and published before the first gate that they affect."""

import json
from typing import Any

import pytest
import yaml
from refused import has_terms, parts

from zsim.contract import keys
from zsim.contract.flight_messages import Velocity
from zsim.contract.run_messages import ControlAnswer, ControlRequest, Done, Event, Faults, Join
from zsim.scenario import faults as fault_kinds
from zsim.scenario import scenario_file
from zsim_world.run.world import World

GATE_NS = 20_000_000
SCENARIO = """
name: one
seed: 3
duration_s: 2
drones:
  - {name: d1, position_m: [0, 0, 0]}
  - {name: d2, position_m: [5, 0, 0]}
clusters: [{name: main, drones: [d1, d2]}]
processes: {expect: []}
"""


def world(faults: str = "[]", delay_gates: int = 1) -> World:
    text = f"{SCENARIO}\nfaults: {faults}\ntime: {{command_delay_gates: {delay_gates}}}"
    return World(scenario_file.from_text(text), run_id="run1")


def ask(made: World, op: str, **args: Any) -> ControlAnswer:
    return made.control(ControlRequest(op, args, "tester.one"))


def add(made: World, kind: str = "gps_dropout", target: str = "d1", **args: Any) -> Any:
    answer = ask(made, "fault_add", kind=kind, target=target, **args)
    assert answer.ok, answer.error
    return answer.result


def go(made: World, gates: int) -> None:
    for _ in range(gates):
        made.advance(0)


def events(made: World) -> list[tuple[int, str, int]]:
    """Return (gate, kind, id) of the fault events since the last call."""
    published = [message for key, message in made.take_outbox() if key == keys.EVENT]
    return [(e.t_ns // GATE_NS, e.kind, e.data["id"]) for e in published if e.kind.startswith("fault")]


def listed(made: World) -> list[list[int]]:
    """Return the fault ids of every list published since the last call."""
    return [[fault.id for fault in m.faults] for _, m in made.take_outbox() if isinstance(m, Faults)]


def test_a_radio_fault_is_refused_during_a_run_whose_agents_have_no_radio():
    """Only with a radio, or a planned radio fault, do gates tell agents which others they hear."""
    word = {"message": "Word", "key": "talk/*/word", "fields": {"said": "number"}}
    agents = {"talk": {"class": "talkers:Talker", "declared": [word]}}
    radio = {"kind": "radio", "target": "main", "range_m": 5}
    for more, is_taken in (({}, False), ({"radio": {}}, True), ({"faults": [radio]}, True)):
        made = World(scenario_file.from_text(json.dumps({**yaml.safe_load(SCENARIO), "agents": agents, **more})))
        answer = ask(made, "fault_add", **radio)
        assert answer.ok is is_taken, answer.error
        assert is_taken or has_terms(answer.error, "kind", "radio")


def test_a_fault_of_a_sensor_that_the_drone_lacks_is_refused():
    sensors = {"d1": {"range": {}}, "d2": {}}
    document = yaml.safe_load(SCENARIO)
    for drone in document["drones"]:
        drone["sensors"] = sensors[drone["name"]]
    made = World(scenario_file.resolve(document))
    assert ask(made, "fault_add", kind="range_stuck", target="d1").ok
    answer = ask(made, "fault_add", kind="range_stuck", target="d2")
    assert has_terms(answer.error, "target", "'d2'", "range", "d1", "range_stuck")


def test_planned_faults_are_published_at_the_start_begun_and_ended():
    kill = "{kind: process_kill, target: estimator.d1, at_s: 0.02}"  # it has no end
    made = world(
        f"[{{kind: gps_dropout, target: d1, at_s: 0.04, for_s: 0.06}}, {{kind: mag_stuck, target: d2}}, {kill}]"
    )
    key, message = made.outbox.pending[0]
    assert (key, [(f.id, f.source) for f in message.faults]) == (keys.FAULTS, [(i, "scenario") for i in (1, 2, 3)])
    go(made, 8)
    assert events(made) == [(0, "fault", 2), (1, "fault", 3), (2, "fault", 1), (5, "fault_end", 1)]


def test_an_event_describes_a_fault_completely():
    made = world()
    go(made, 3)
    add(made, "baro_bias", value_m=2, for_s=1)
    go(made, 1)
    event = next(m for k, m in made.take_outbox() if k == keys.EVENT and m.kind == "fault")
    assert event.subject == "d1"
    assert has_terms(event.text, "baro_bias", "d1")
    what = {"id": 1, "kind": "baro_bias", "target": "d1", "parameters": {"value_m": 2.0}, "rank": 0}
    assert event.data == {**what, "from_ns": 2 * GATE_NS, "until_ns": 52 * GATE_NS, "source": "tester.one"}


def test_a_requested_fault_is_published_before_the_first_unseen_gate():
    made = world(delay_gates=5)
    go(made, 4)
    made.take_outbox()
    assert add(made, for_s=0.04) == {"id": 1, "from_ns": 3 * GATE_NS, "until_ns": 5 * GATE_NS}
    go(made, 1)
    published = [key for key, _ in made.take_outbox() if key in (keys.FAULTS, keys.GATE)]
    assert published == [keys.FAULTS, keys.GATE]


def test_an_ended_fault_stays_listed_while_its_gates_may_be_in_use():
    made = world(delay_gates=3)
    go(made, 1)
    add(made, for_s=0.04)
    assert listed(made)[-1] == [1]
    go(made, 5)
    assert listed(made) == []
    go(made, 1)
    assert listed(made) == [[]]


def test_nothing_is_kept_of_a_fault_that_is_no_longer_listed():
    made = world("[{kind: gps_dropout, target: d1, at_s: 0.02, for_s: 0.04}]")
    go(made, 1)
    add(made, "mag_stuck", "d2")
    go(made, 1)
    ask(made, "fault_clear", kind="mag_stuck")
    assert made.faults._begun
    go(made, 8)
    assert made.faults.all == ()
    assert made.faults._begun == made.faults._over == set()


def joined(made: World, name: str, period_gates: int, fingerprint: str = "x") -> None:
    """Let a process join as `zsim.runtime.runner` does or, without a fingerprint, as another program."""
    run_id, period_ns = made.info().run_id, period_gates * GATE_NS
    join = Join(0, 0, run_id, 1, name.partition(".")[0], "here", 1, period_ns, fingerprint=fingerprint)
    made.handle(keys.process(name, "join"), join, 0)


def test_an_ended_fault_stays_listed_for_a_process_with_a_long_period():
    """A process that steps every fourth gate hands its agent gates from up to four gates plus the delay ago."""
    made = world(delay_gates=3)
    joined(made, "slow.one", 4)
    go(made, 1)
    add(made, for_s=0.04)
    made.take_outbox()
    lists = []
    for gate in range(1, 16):
        made.handle(keys.process("slow.one", "done"), Done(0, gate, made.info().run_id, 1, gate * GATE_NS, 0), 0)
        go(made, 1)
        lists += [(gate, ids) for ids in listed(made)]
    assert lists == [(2 + 3 + 4 + 1, [])]


@pytest.mark.parametrize(
    ("name", "period_gates", "fingerprint", "refused"),
    [
        ("console.one", 0, "x", True),
        ("my.filter", 1, "", True),
        ("estimator.d1", 0, "x", True),
        ("my.filter", 1, "x", False),
    ],
)
def test_a_kill_of_a_process_that_does_not_read_faults_is_refused(
    name: str, period_gates: int, fingerprint: str, refused: bool
):
    made = world()
    joined(made, name, period_gates, fingerprint)
    answer = ask(made, "fault_add", kind="process_kill", target=name)
    assert answer.ok == (not refused)
    if refused:
        where, found = parts(answer.error)
        assert (where, found.partition(",")[0]) == ("target", repr(name))


def test_a_planned_kill_without_effect_is_reported():
    made = world("[{kind: process_kill, target: estimator.d1, at_s: 0.04}]")
    joined(made, "estimator.d1", 0)
    go(made, 4)
    texts = [message.text for key, message in made.take_outbox() if key == keys.EVENT and message.kind == "fault"]
    assert len(texts) == 1
    assert has_terms(texts[0], "process_kill", "estimator.d1", "no effect")


def test_equal_faults_are_ranked_by_start_and_keep_their_rank():
    """Thus the same faults, planned from their start events, draw the same random numbers."""

    def ranks() -> dict[int, int]:
        return {fault.id: fault.rank for fault in made.faults.all}

    cut = {"kind": "link_loss", "target": "world/controller.main", "probability": 0.5}
    made = world()
    for more in ({"for_s": 0.04}, {}, {"at_s": 0.02}, {}):
        add(made, **{**cut, **more})
    assert ranks() == {1: 0, 2: 1, 3: 0, 4: 2}
    ask(made, "fault_clear", id=2)
    assert ranks() == {1: 0, 3: 0, 4: 1}
    go(made, 8)
    assert ranks() == {3: 0, 4: 1}


def test_link_faults_at_a_gate_are_those_that_act_then():
    made = world()
    add(made, "link_cut", "world/controller.main", at_s=0.04, for_s=0.04)
    add(made, "radio", "main", range_m=10)
    add(made, "gps_dropout")
    for _ in range(8):
        for gate in range(12):
            t_ns = gate * GATE_NS
            acting = [each for each in made.faults.all if fault_kinds.acts(each, t_ns) and each.kind != "gps_dropout"]
            assert list(made.faults.of_links(gate * GATE_NS)) == acting
        go(made, 1)


def test_clearing_ends_active_faults_and_removes_planned_ones():
    made = world()
    go(made, 2)
    add(made, "gps_dropout")
    add(made, "gps_stuck", at_s=1.0)
    go(made, 2)
    made.take_outbox()
    assert ask(made, "fault_clear").result == {"cleared": [1, 2]}
    published = made.take_outbox()
    cleared = [m for _, m in published if isinstance(m, Event) and m.kind == "fault_clear"]
    assert [(m.data["id"], m.source) for m in cleared] == [(1, "tester.one"), (2, "tester.one")]
    (faults,) = [m for _, m in published if isinstance(m, Faults)]
    assert [(fault.id, fault.until_ns) for fault in faults.faults] == [(1, 3 * GATE_NS)]
    go(made, 60)
    assert events(made) == []
    assert ask(made, "fault_clear").result == {"cleared": []}


@pytest.mark.parametrize(
    ("args", "cleared"), [({"id": 2}, [2]), ({"target": "d1"}, [1, 2]), ({"kind": "gps_stuck"}, [2, 3])]
)
def test_faults_are_cleared_by_id_target_or_kind(args: dict[str, Any], cleared: list[int]):
    made = world()
    go(made, 1)
    for kind, target in (("gps_dropout", "d1"), ("gps_stuck", "d1"), ("gps_stuck", "d2")):
        add(made, kind, target)
    assert ask(made, "fault_clear", **args).result == {"cleared": cleared}


@pytest.mark.parametrize(
    ("op", "args", "where", "found"),
    [
        ("fault_add", {}, "kind", "missing"),
        ("fault_add", {"kind": "gps_dropout", "target": "d3"}, "target", "'d3'"),
        ("fault_add", {"kind": "gps_dropout", "target": "d1", "at_s": 0.01}, "at_s", "0.01"),
        ("fault_add", {"kind": "gps_dropout", "target": "d1", "at_s": 2.0}, "at_s", "2"),
        ("fault_add", {"kind": "process_kill", "target": "my.filter"}, "target", "'my.filter'"),
        ("fault_clear", {"id": 7}, "id", "7"),
        ("fault_clear", {"name": 7}, "name", "not known"),
    ],
)
def test_a_refusal_is_one_line_with_the_argument_and_its_value(op: str, args: dict[str, Any], where: str, found: str):
    made = world()
    go(made, 4)
    add(made)
    answer = ask(made, op, **args)
    assert not answer.ok
    assert parts(answer.error) == (where, found)
    assert len(answer.error.splitlines()) == 1


def test_clearing_all_faults_restores_the_original_state():
    made, sound = world(), world()
    faults: tuple[tuple[str, dict[str, Any]], ...] = (
        ("gps_noise", {"factor": 2}),
        ("accel_bias", {"value_m_s2": [1, 0, 0]}),
        ("mag_dropout", {"probability": 0.5}),
        ("rotor_efficiency", {"rotor": "all", "value": 0.5}),
    )
    for kind, more in faults:
        add(made, kind, **more)
    add(made, "gust", "world", velocity_m_s=[1, 2, 3], for_s=1)
    go(made, 20)
    go(sound, 20)
    assert made.fleet.wind_m_s.tolist() != sound.fleet.wind_m_s.tolist()
    ask(made, "fault_clear")
    go(made, 1)
    assert (made.fleet._w.senses.config == sound.fleet._w.senses.config).all()
    assert (made.fleet.boards.actuator == sound.fleet.boards.actuator).all()
    assert (made.fleet._w.wind == sound.fleet._w.wind).all()


@pytest.mark.parametrize(
    ("kind", "sender", "more", "applied_after"),
    [
        ("link_delay", "pilot.me", {"delay_ms": 50}, 4),
        ("link_cut", "pilot.me", {}, None),
        ("link_cut", "pilot.other", {}, 1),
    ],
)
def test_link_faults_delay_or_drop_commands(kind: str, sender: str, more: dict[str, Any], applied_after: int | None):
    """The sender is not in the lockstep: its command takes effect one gate after its arrival, plus the delay."""
    made = world()
    go(made, 1)
    add(made, kind, f"{sender}/world", **more)
    made.handle(keys.command("d1", "velocity"), Velocity(0, 0, "pilot.me", (0.0, 0.0, 0.0), 0.0), 0)
    applied = [m.data["apply_t_ns"] for _, m in made.take_outbox() if isinstance(m, Event) and m.kind == "command"]
    assert applied == ([] if applied_after is None else [(1 + applied_after) * GATE_NS])


def test_a_command_from_beyond_radio_range_is_lost():
    made = world()
    go(made, 1)
    add(made, "radio", "main", range_m=10, spread_m=0.1, place={"pilot.me": [100, 0, 0]})
    for drone, seq in (("d1", 0), ("d2", 1)):
        made.handle(keys.command(drone, "velocity"), Velocity(0, seq, "pilot.me", (0.0, 0.0, 0.0), 0.0), 0)
    made.handle(keys.command("d1", "velocity"), Velocity(0, 0, "pilot.near", (0.0, 0.0, 0.0), 0.0), 0)
    go(made, 4)
    refused = [m.source for _, m in made.take_outbox() if isinstance(m, Event) and m.kind == "refused"]
    assert refused == ["pilot.near"]  # only its command arrives, and a drone on the ground refuses it


def test_the_radio_of_one_formation_loses_no_command_to_another():
    drones = [{"name": f"d{k}", "position_m": [5 * k, 0, 0]} for k in range(1, 5)]
    clusters = [{"name": "main", "drones": ["d1", "d2"]}, {"name": "other", "drones": ["d3", "d4"]}]
    document = {**yaml.safe_load(SCENARIO), "drones": drones, "clusters": clusters}
    made = World(scenario_file.from_text(json.dumps(document)), run_id="run1")
    go(made, 1)
    add(made, "radio", "main", range_m=10, spread_m=0.1, place={"pilot.me": [100, 0, 0]})
    for drone in ("d1", "d3"):
        made.handle(keys.command(drone, "velocity"), Velocity(0, 0, "pilot.me", (0.0, 0.0, 0.0), 0.0), 0)
    go(made, 4)
    refused = [m.subject for _, m in made.take_outbox() if isinstance(m, Event) and m.kind == "refused"]
    assert refused == ["drone/d3/cmd/velocity"]  # only its command arrives, and a drone on the ground refuses it
