"""Commands to external drones: judged as all others, and repeated at once for the driver to obey."""

from typing import Any

import pytest
from continued import continue_from
from refused import has_terms, refused

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Ardrone, Mode, Status, Truth, Velocity
from zsim.contract.framing import GateMessages
from zsim.contract.run_messages import ControlRequest, Done, Event, Join
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim_world.run.world import World

GATE_NS = 20_000_000
SCENARIO = """
name: mixed
duration_s: 10
time: {command_delay_gates: 5}
drones:
  - {name: d1, position_m: [0, 0, 0]}
  - {name: d2, position_m: [4, 0, 0], body: external}
processes: {expect: []}
"""
ME, OTHER = "pilot.one", "pilot.two"
ZEROS = (0.0, 0.0, 0.0)


def world_of(text: str = SCENARIO, mode: str = "realtime") -> World:
    return World(scenario_file.from_text(text), mode, 1.0, run_id="run1")


def status(t_ns: int, state: Any = "hovering") -> Status:
    return Status(t_ns, 0, state, 70.0, False, None, 1)


@pytest.fixture
def world() -> World:
    made = world_of()
    for _ in range(20):
        made.advance(0)
    made.handle(keys.process(ME, "join"), Join(0, 0, "run1", 1, "pilot", "h", 1, GATE_NS), 0)
    assert made.take_of_driver("d2", status(made.now_ns)) is None
    made.take_outbox()
    return made


def velocity(world: World, source: str = ME, seq: int = 0, speed: float = 1.0) -> Velocity:
    return Velocity(world.now_ns, seq, source, (speed, 0.0, 0.0), 0.2, "world")


def command(world: World, message: Any, kind: str = "velocity", drone: str = "d2") -> list[tuple[str, Any]]:
    """Send a command; return what the world publishes because of it, without passing time."""
    world.handle(keys.command(drone, kind), message, 0)
    return world.take_outbox()


def kinds(published: list[tuple[str, Any]]) -> list[str]:
    return [message.kind for _, message in published if isinstance(message, Event)]


def test_an_accepted_command_is_repeated_at_once(world: World):
    sent = [velocity(world, seq=10 + seq) for seq in range(3)]
    for seq, each in enumerate(sent):
        published = command(world, each)
        accepted = [message for key, message in published if key == keys.accepted("d2", "velocity")]
        assert accepted == [Velocity(each.t_ns, seq, ME, each.velocity_m_s, 0.2, "world")]
        assert kinds(published) == (["commander"] if seq == 0 else [])
        assert command(world, each) == []  # the same again
    assert world.queue.commanders() == [None, ME]
    world.advance(0)
    assert not [key for key, _ in world.take_outbox() if "/accepted/" in key]
    assert command(world, sent[-1]) == []


def test_a_second_source_is_refused_until_it_acquires_the_drone(world: World):
    command(world, velocity(world))
    (refusal,) = [message for _, message in command(world, velocity(world, OTHER)) if isinstance(message, Event)][1:]
    assert (refusal.kind, refusal.source) == ("refused", OTHER)
    assert ME in refusal.data["reason"]
    answer = world.control(ControlRequest("acquire", {"drone": "d2", "priority": 10}, OTHER))
    assert answer.ok
    world.take_outbox()
    accepted = dict(command(world, velocity(world, OTHER, 1)))[keys.accepted("d2", "velocity")]
    assert accepted.source == OTHER
    assert "refused" in kinds(command(world, velocity(world, seq=5)))


def test_modes_are_judged_by_the_state_of_the_driver(world: World):
    published = command(world, Mode(world.now_ns, 0, ME, "takeoff"), "mode")
    assert kinds(published) == ["refused"]
    assert has_terms(published[0][1].text, "d2 is hovering", "landed")
    world.take_of_driver("d2", status(world.now_ns, "landed"))
    published = command(world, Mode(world.now_ns, 1, ME, "takeoff"), "mode")
    assert kinds(published) == ["mode"]
    assert dict(published)[keys.accepted("d2", "mode")] == Mode(world.now_ns, 0, ME, "takeoff")


def test_an_old_command_is_refused(world: World):
    world.take_outbox()
    message = Velocity(0, 0, ME, ZEROS, 0.0)
    for _ in range(10):
        world.advance(0)
    world.take_outbox()
    assert kinds(command(world, message)) == ["refused"]


def test_one_who_has_not_joined_has_the_event_of_his_command(world: World):
    published = command(world, velocity(world, OTHER))
    assert kinds(published) == ["command", "commander"]
    assert published[0][1].data["apply_t_ns"] == world.now_ns
    assert keys.accepted("d2", "velocity") in dict(published)


def test_who_releases_it_lets_it_hover(world: World):
    command(world, velocity(world))
    assert world.control(ControlRequest("release", {"drone": "d2"}, ME)).ok
    hover = dict(world.take_outbox())[keys.accepted("d2", "ardrone")]
    assert hover == Ardrone(world.now_ns, 0, "world", 0.0, 0.0, 0.0, 0.0, hover=True)
    command(world, velocity(world, seq=1))
    world.release_drones(ME)
    assert dict(world.take_outbox())[keys.accepted("d2", "ardrone")].seq == 1


def test_faults_of_its_link_delay_and_lose_a_command(world: World):
    asked = {"kind": "link_delay", "target": f"{ME}/world", "delay_ms": 30, "for_s": 0.2}
    assert world.control(ControlRequest("fault_add", asked, "x")).ok
    world.advance(0)
    world.take_outbox()
    assert command(world, velocity(world)) == []
    sent = []
    for _ in range(4):
        world.advance(0)
        sent.append(keys.accepted("d2", "velocity") in dict(world.take_outbox()))
    assert sent.count(True) == 1
    assert sent.index(True) == 2  # two gates later: the command is handed on before the third is integrated


@pytest.mark.parametrize("kind", ["gps_noise", "rotor_efficiency", "imu_dropout"])
def test_no_fault_acts_on_what_nobody_simulates(world: World, kind: str):
    more = {"gps_noise": {"factor": 2}, "rotor_efficiency": {"rotor": "all", "value": 0.5}}.get(kind, {})
    answer = world.control(ControlRequest("fault_add", {"kind": kind, "target": "d2", **more}, "x"))
    assert has_terms(answer.error, "target", "'d2'", "external")
    assert world.control(ControlRequest("fault_add", {"kind": kind, "target": "d1", **more}, "x")).ok


def test_views_and_the_hash_know_who_is_external(world: World):
    pose = Truth(world.now_ns, 0, (4.0, 1.0, 2.0), ZEROS, (1.0, *ZEROS), ZEROS, ZEROS, (300.0,) * 4)
    world.take_of_driver("d2", pose)
    world.advance(0)
    _, shown = world.view(0).drones
    assert (shown.position_m, shown.state, shown.battery_percent) == ((4.0, 1.0, 2.0), "hovering", 70.0)
    assert [drone.body for drone in world.info().drones] == [messages.UNSET, "external"]
    gates = [message for key, message in world.take_outbox() if key == keys.GATE]
    assert gates
    assert all(isinstance(gate, GateMessages) and {keys.thing(k) for k, _ in gate.pairs} == {"d1"} for gate in gates)
    moved = world_of()
    alone = world_of(SCENARIO.replace("body: external", "battery_percent: 50"))
    for each in (moved, alone):
        for _ in range(5):
            each.take_of_driver("d2", pose) if each is moved else None
            each.advance(0)
    assert moved.result()["truth_sha256"] != alone.result()["truth_sha256"]


def test_the_result_has_the_least_distance_of_the_whole_run(world: World):
    for x_m in (4.0, 2.0, 3.0):
        pose = Truth(world.now_ns, 0, (x_m, 0.0, 0.058), ZEROS, (1.0, *ZEROS), ZEROS, ZEROS, (300.0,) * 4)
        assert world.take_of_driver("d2", pose) is None
        world.advance(0)
    assert world.result()["closest_m"] == pytest.approx(2.0, abs=0.01)


def test_the_hash_is_that_of_the_simulated_drones():
    only = world_of(SCENARIO.replace("  - {name: d2, position_m: [4, 0, 0], body: external}\n", ""), "lockstep")
    mixed = world_of()
    for _ in range(30):
        only.advance(0)
        mixed.advance(0)
    assert mixed.result()["truth_sha256"] == only.result()["truth_sha256"]


def test_estimators_of_it_have_no_deadlines_and_may_wait_for_the_driver_as_long_as_it_takes(world: World):
    for name in ("estimator.d2", "estimator.d1"):
        world.handle(keys.process(name, "join"), Join(0, 0, "run1", 1, "estimator", "h", 1, GATE_NS), 0)
    waits = {name: world.must_wait_for(p) for name, p in world.barrier.participants.items()}
    assert (waits["estimator.d1"], waits["estimator.d2"]) == (False, True)
    for _ in range(20):
        world.advance(0)
    misses = world.result()["deadline_misses_by"]
    assert misses["estimator.d2"] == 0
    assert misses["estimator.d1"] > 0
    world.handle(keys.process("estimator.d2", "done"), Done(world.now_ns, 0, "run1", 1, world.now_ns, 0), 0)
    assert world.barrier.participants["estimator.d2"].done_ns == world.now_ns


def test_a_world_that_goes_on_elsewhere_has_what_drivers_published(world: World):
    command(world, velocity(world))
    other = world_of()
    continue_from(world, other)
    for each in (world, other):
        each.advance(0)
    published = dict(command(other, velocity(other, seq=1)))
    assert published[keys.accepted("d2", "velocity")].seq == 1
    assert other.view(0) == world.view(0)


def test_lockstep_is_refused_with_the_reason():
    with refused(ScenarioError, "mixed", "d2", "external", "lockstep", "--realtime"):
        world_of(mode="lockstep")


def test_an_emergency_that_a_driver_reports_in_flight_is_an_event_once(world: World):
    for state in ("emergency", "emergency", "landed", "emergency"):
        assert world.take_of_driver("d2", status(world.now_ns, state)) is None
    (event,) = [m for _, m in world.take_outbox() if isinstance(m, Event) and m.kind == "emergency"]
    assert (event.subject, event.data) == ("d2", {"cause": "driver"})
