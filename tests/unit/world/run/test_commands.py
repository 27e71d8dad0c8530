"""Commands: who commands a drone, the order at one instant, refusals, and commands to external drones."""

import random
from typing import Any

import pytest
from continued import continue_from
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import has_terms, parts, refused
from small_world import GATE_NS, events_of, small_world

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Ardrone, Mode, Status, Truth, Velocity
from zsim.contract.framing import GateMessages
from zsim.contract.run_messages import ControlRequest, Done, Event, Join
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim_world.run.commands import PRIORITY_MAX, PROGRAM, RECENT_PER_DRONE, CommandQueue, QueuedCommand
from zsim_world.run.outbox import Refusal
from zsim_world.run.world import World

D1, D2 = 0, 1
OPERATOR = 10  # priority that docs/protocol.md gives to operators


def velocity(source: str, seq: int = 0, t_ns: int = 0, x: float = 1.0) -> Velocity:
    return Velocity(t_ns, seq, source, (x, 0.0, 0.0), 0.0)


def mode(source: str, what: str, seq: int = 0, t_ns: int = 0) -> Mode:
    return Mode(t_ns, seq, source, what)  # type: ignore[arg-type]


@pytest.fixture
def queue() -> CommandQueue:
    return CommandQueue(["drone1", "drone2"])


def fly(made: CommandQueue, t_ns: int) -> list[tuple[QueuedCommand, Refusal | None]]:
    """Apply due commands as the world does: check each, then make the source of a setpoint the commander."""
    checked = []
    for command in made.pop(t_ns):
        reason = made.refusal(command)
        if reason is None and command.kind != "mode":
            made.claim(command.drone, command.source)
        checked.append((command, reason))
    return checked


def send(made: CommandQueue, drone: int, source: str) -> Refusal | None:
    made.push(drone, "velocity", velocity(source), 0)
    ((_, reason),) = fly(made, 0)
    return reason


# The order of commands


def test_a_command_waits_for_its_instant(queue: CommandQueue):
    queue.push(D1, "velocity", velocity("a"), GATE_NS)
    assert queue.pop(GATE_NS - 1) == []
    assert [command.source for command in queue.pop(GATE_NS)] == ["a"]
    assert queue.pop(GATE_NS) == []


@settings(max_examples=100, deadline=None)
@given(order=st.randoms(use_true_random=False))
def test_commands_of_one_instant_are_ordered_by_priority_source_and_number(order: random.Random):
    """Whatever the order of arrival, earlier instants come first; the last command applied wins."""
    made = CommandQueue(["drone1"])
    made.acquire(D1, "a.operator", OPERATOR)
    wanted = [(0, "b", 2), (0, "b", 9), (0, "c", 1), (0, "c", 10), (10, "a.operator", 0), (10, "a.operator", 3)]
    arrivals = [(source, seq, at) for at in (GATE_NS, 2 * GATE_NS) for _, source, seq in wanted]
    order.shuffle(arrivals)
    for source, seq, at in arrivals:
        made.push(D1, "velocity", velocity(source, seq, at - GATE_NS), at)
    popped = made.pop(2 * GATE_NS)
    assert [(command.priority, command.source, command.seq) for command in popped] == wanted * 2
    assert [command.apply_ns for command in popped] == [GATE_NS] * 6 + [2 * GATE_NS] * 6


@settings(max_examples=50, deadline=None)
@given(order=st.randoms(use_true_random=False))
def test_ties_are_not_broken_by_the_order_of_arrival(order: random.Random):
    made = CommandQueue(["drone1", "drone2"])
    in_order = [(drone, kind) for drone in (D1, D2) for kind in ("mode", "velocity")]
    arrivals = [*in_order]
    order.shuffle(arrivals)
    for drone, kind in arrivals:
        made.push(drone, kind, velocity("a") if kind == "velocity" else mode("a", "takeoff"), 0)
    assert [(command.drone, command.kind) for command in made.pop(0)] == in_order


def test_a_repeated_command_takes_effect_once(queue: CommandQueue):
    """After a rejoin, for example, an old setpoint must not replace a newer one."""
    old, new = velocity("a", 1, 0, x=1.0), velocity("a", 2, GATE_NS, x=2.0)
    pushed = [(old, GATE_NS), (old, GATE_NS), (new, 2 * GATE_NS)]
    assert [queue.push(D1, "velocity", *each) for each in pushed] == [True, False, True]
    assert [command.message for command in queue.pop(2 * GATE_NS)] == [old, new]
    assert [queue.push(D1, "velocity", *each) for each in pushed] == [False] * 3
    assert queue.pop(9 * GATE_NS) == []


def test_a_sequence_number_may_recur_for_another_drone_kind_or_instant(queue: CommandQueue):
    command = velocity("a")
    assert queue.push(D1, "velocity", command, GATE_NS)
    assert queue.push(D2, "velocity", command, GATE_NS)
    assert queue.push(D1, "velocity", command, 2 * GATE_NS)
    assert queue.push(D1, "mode", mode("a", "land"), GATE_NS)
    assert queue.push(D1, "mode", mode("a", "takeoff"), GATE_NS)
    assert len(queue.pop(2 * GATE_NS)) == 5


def test_the_memory_of_recent_commands_is_bounded(queue: CommandQueue):
    for seq in range(10 * RECENT_PER_DRONE):
        queue.push(D1, "velocity", velocity("a", seq), 0)
        queue.pop(0)
    assert len(queue._recent) <= 2 * RECENT_PER_DRONE


# The commander


def test_the_first_setpoint_takes_command_and_other_sources_are_refused(queue: CommandQueue):
    assert queue.commanders() == [None, None]
    assert send(queue, D1, "controller.main") is None
    reason = send(queue, D1, "console.1")
    assert reason is not None
    assert reason[0] == "drone1"
    assert has_terms(reason[1], "'controller.main'", "priority 0")
    assert queue.commanders() == ["controller.main", None]
    assert send(queue, D2, "console.1") is None


def test_claim_returns_whether_the_commander_is_new(queue: CommandQueue):
    assert [queue.claim(D1, source) for source in ("a", "a", "b")] == [True, False, False]


def test_only_a_higher_priority_acquires_a_commanded_drone(queue: CommandQueue):
    send(queue, D1, "controller.main")
    refusal = queue.acquire(D1, "console.1", PROGRAM)
    assert refusal is not None
    assert refusal[0] == "drone1"
    assert has_terms(refusal[1], "'controller.main'", "priority 0")
    assert queue.acquire(D1, "console.1", OPERATOR) is None
    assert queue.acquire(D1, "console.2", OPERATOR) is not None
    assert queue.commanders()[D1] == "console.1"
    assert queue.acquire(D1, "console.2", OPERATOR + 1) is None
    assert queue.acquire(D1, "console.2", PROGRAM) is None  # the commander may change its own priority
    assert queue.acquire(D1, "console.3", PROGRAM + 1) is None


def test_a_release_frees_the_drone_and_drops_the_priority(queue: CommandQueue):
    queue.acquire(D1, "console.1", OPERATOR)
    assert queue.release(D1, "console.1") is None
    assert queue.commanders()[D1] is None
    send(queue, D1, "console.1")
    assert queue.acquire(D1, "other", PROGRAM + 1) is None


@pytest.mark.parametrize(("holder", "who"), [("a", "'a'"), (None, "nobody")])
def test_only_the_commander_can_release_a_drone(queue: CommandQueue, holder: str | None, who: str):
    if holder:
        queue.claim(D1, holder)
    refusal = queue.release(D1, "b")
    assert refusal is not None
    assert refusal[0] == "drone1"
    assert has_terms(refusal[1], who, "not", "'b'")
    assert queue.commanders()[D1] == holder


def test_a_pending_setpoint_does_not_undo_a_release(queue: CommandQueue):
    send(queue, D1, "a")
    queue.push(D1, "velocity", velocity("a", 1), GATE_NS)
    queue.push(D1, "mode", mode("a", "land"), GATE_NS)
    queue.push(D2, "velocity", velocity("a", 1), GATE_NS)
    queue.release(D1, "a")
    assert [(command.drone, command.kind) for command, _ in fly(queue, GATE_NS)] == [(D1, "mode"), (D2, "velocity")]
    assert queue.commanders() == [None, "a"]


def test_a_removed_source_commands_no_drone_and_has_no_priority(queue: CommandQueue):
    queue.acquire(D1, "a", OPERATOR)
    send(queue, D2, "a")
    queue.push(D1, "velocity", velocity("a", 1), GATE_NS)
    queue.push(D2, "mode", mode("a", "land"), GATE_NS)
    queue.push(D2, "velocity", velocity("b", 1), GATE_NS)
    assert [queue.remove_source("a"), queue.remove_source("a")] == [[D1, D2], []]
    assert queue.commanders() == [None, None]
    assert [(command.source, command.kind) for command in queue.pop(GATE_NS)] == [("a", "mode"), ("b", "velocity")]
    queue.push(D1, "velocity", velocity("a", 2), 0)
    assert [command.priority for command in queue.pop(0)] == [PROGRAM]


def test_an_outbid_source_loses_its_priority_when_removed(queue: CommandQueue):
    queue.acquire(D1, "console.1", OPERATOR)
    queue.acquire(D1, "console.2", OPERATOR + 1)
    assert queue.remove_source("console.1") == []
    queue.release(D1, "console.2")
    queue.push(D1, "velocity", velocity("console.1"), 0)
    assert [command.priority for command in queue.pop(0)] == [PROGRAM]


# Modes


@pytest.mark.parametrize(
    ("priority", "refused"), [(PROGRAM, True), (OPERATOR - 1, True), (OPERATOR, False), (OPERATOR + 1, False)]
)
def test_modes_require_at_least_the_priority_of_the_commander(queue: CommandQueue, priority: int, refused: bool):
    queue.acquire(D1, "a", OPERATOR)
    reason = queue.refusal(QueuedCommand(0, priority, "b", 0, D1, "mode", mode("b", "land")))
    assert (reason is not None) is refused


@pytest.mark.parametrize("commander", [None, "controller.main"])
def test_modes_are_open_to_all_unless_an_operator_commands(queue: CommandQueue, commander: str | None):
    if commander:
        send(queue, D1, commander)
    queue.push(D1, "mode", mode("other", "land"), 0)
    ((_, reason),) = fly(queue, 0)
    assert reason is None
    assert queue.commanders()[D1] == commander


# In a world

AGE_MAX_MS = 400


def refusals(mode: str, age_ms: int, kind: str = "velocity") -> list[dict[str, Any]]:
    """Return the refusals of a command stamped at gate 0 that arrives this much later."""
    world = small_world(mode, duration_s=10, time={"max_command_age_ms": AGE_MAX_MS})
    for _ in range(1 + age_ms * 1_000_000 // GATE_NS):
        world.advance(0)
    command = Mode(0, 0, "me.x", "land") if kind == "mode" else Velocity(0, 0, "me.x", (0.0, 0.0, 0.0), 0.0)
    world.handle(keys.command("d1", kind), command, 0)
    return [event.data for event in events_of(world, "refused")]


@pytest.mark.parametrize("kind", ["velocity", "mode"])
def test_an_old_command_is_refused_only_in_realtime(kind: str):
    (refusal,) = refusals("realtime", AGE_MAX_MS + 20, kind)
    assert has_terms(refusal["reason"], "age", "420 ms", "400 ms")
    assert refusals("realtime", AGE_MAX_MS, kind) == refusals("lockstep", 10 * AGE_MAX_MS, kind) == []


@pytest.mark.parametrize(("priority", "ok"), [(0, True), (PRIORITY_MAX, True), (-1, False), (PRIORITY_MAX + 1, False)])
def test_acquire_takes_exactly_the_priorities_of_the_protocol(priority: int, ok: bool):
    world = small_world("realtime")
    answer = world.control(ControlRequest("acquire", {"drone": "d1", "priority": priority}, "me.x"))
    assert answer.ok == ok


MISSION = {"drone": "d1", "state": "aborted", "items": 5, "done": 3, "reason": "it left its geofence", "failsafe": True}


def reported(**changed: Any) -> tuple[str, list[Event]]:
    """Report a mission; return the refusal and the mission events."""
    world = small_world("realtime")
    world.advance(0)
    answer = world.control(ControlRequest("mission", MISSION | changed, "mavlink.main"))
    return answer.error, events_of(world, "mission")


def test_a_reported_mission_becomes_an_event_of_its_drone():
    error, (event,) = reported()
    assert (error, event.subject, event.source) == ("", "d1", "mavlink.main")
    assert event.data == {name: value for name, value in MISSION.items() if name != "drone"}
    assert has_terms(event.text, "3 of 5 items", "geofence")


@pytest.mark.parametrize(
    "changed", [{"drone": "d9"}, {"state": "lost"}, {"items": -1}, {"done": "3"}, {"done": 10**9}, {"items": True}]
)
def test_an_invalid_mission_report_is_refused_without_an_event(changed: dict[str, Any]):
    error, found = reported(**changed)
    ((name, value),) = changed.items()
    assert error.startswith(f"{name} is {value!r}; must be ")
    assert found == []


MIXED = """
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


def world_of(text: str = MIXED, mode: str = "realtime") -> World:
    return World(scenario_file.from_text(text), mode, 1.0, run_id="run1")


def status(t_ns: int, state: Any = "hovering") -> Status:
    return Status(t_ns, 0, state, 70.0, False, None, 1)


@pytest.fixture
def world() -> World:
    made = world_of()
    for _ in range(20):
        made.advance(0)
    made.handle(keys.process(ME, "join"), Join(0, 0, "run1", 1, "pilot", "h", 1, GATE_NS), 0)
    assert made.accept_from_driver("d2", status(made.now_ns)) is None
    made.take_outbox()
    return made


def to_fly(world: World, source: str = ME, seq: int = 0, speed: float = 1.0) -> Velocity:
    return Velocity(world.now_ns, seq, source, (speed, 0.0, 0.0), 0.2, "world")


def command(world: World, message: Any, kind: str = "velocity", drone: str = "d2") -> list[tuple[str, Any]]:
    """Send a command; return what the world publishes in response, without advancing time."""
    world.handle(keys.command(drone, kind), message, 0)
    return world.take_outbox()


def kinds(published: list[tuple[str, Any]]) -> list[str]:
    return [message.kind for _, message in published if isinstance(message, Event)]


def test_an_accepted_command_is_republished_at_once(world: World):
    sent = [to_fly(world, seq=10 + seq) for seq in range(3)]
    for seq, each in enumerate(sent):
        published = command(world, each)
        accepted = [message for key, message in published if key == keys.accepted("d2", "velocity")]
        assert accepted == [Velocity(each.t_ns, seq, ME, each.velocity_m_s, 0.2, "world")]
        assert kinds(published) == (["commander"] if seq == 0 else [])
        assert command(world, each) == []  # a repetition is ignored
    assert world.queue.commanders() == [None, ME]
    world.advance(0)
    assert not [key for key, _ in world.take_outbox() if "/accepted/" in key]
    assert command(world, sent[-1]) == []


def test_a_second_source_is_refused_until_it_acquires_the_drone(world: World):
    command(world, to_fly(world))
    (refusal,) = [message for _, message in command(world, to_fly(world, OTHER)) if isinstance(message, Event)][1:]
    assert (refusal.kind, refusal.source) == ("refused", OTHER)
    assert ME in refusal.data["reason"]
    answer = world.control(ControlRequest("acquire", {"drone": "d2", "priority": 10}, OTHER))
    assert answer.ok
    world.take_outbox()
    accepted = dict(command(world, to_fly(world, OTHER, 1)))[keys.accepted("d2", "velocity")]
    assert accepted.source == OTHER
    assert "refused" in kinds(command(world, to_fly(world, seq=5)))


def test_modes_are_checked_against_the_state_the_driver_reports(world: World):
    published = command(world, Mode(world.now_ns, 0, ME, "takeoff"), "mode")
    assert kinds(published) == ["refused"]
    assert has_terms(published[0][1].text, "d2 is hovering", "landed")
    world.accept_from_driver("d2", status(world.now_ns, "landed"))
    published = command(world, Mode(world.now_ns, 1, ME, "takeoff"), "mode")
    assert kinds(published) == ["mode"]
    assert dict(published)[keys.accepted("d2", "mode")] == Mode(world.now_ns, 0, ME, "takeoff")


def test_an_old_command_to_an_external_drone_is_refused(world: World):
    world.take_outbox()
    message = Velocity(0, 0, ME, ZEROS, 0.0)
    for _ in range(10):
        world.advance(0)
    world.take_outbox()
    assert kinds(command(world, message)) == ["refused"]


def test_a_command_from_a_source_that_has_not_joined_is_an_event(world: World):
    published = command(world, to_fly(world, OTHER))
    assert kinds(published) == ["command", "commander"]
    assert published[0][1].data["apply_t_ns"] == world.now_ns
    assert keys.accepted("d2", "velocity") in dict(published)


def test_a_command_to_an_unknown_drone_is_refused_with_a_shortened_name(world: World):
    ((_, refused),) = command(world, to_fly(world), drone="d" * 60)
    assert (refused.kind, parts(refused.data["reason"])) == ("refused", ("drone", repr("d" * 40)))


def test_a_released_simulated_drone_hovers():
    made = small_world()
    made.handle(keys.command("d1", "mode"), Mode(0, 0, ME, "takeoff"), 0)
    for _ in range(300):
        made.advance(0)
    made.handle(keys.command("d1", "velocity"), Velocity(made.now_ns, 1, ME, (1.0, 0.0, 0.0), 0.0), 0)
    for _ in range(5):  # a setpoint that is not repeated is soon dropped
        made.advance(0)
    assert made.view(0).drones[0].state == "flying"
    assert made.control(ControlRequest("release", {"drone": "d1"}, ME)).ok
    made.advance(0)
    assert made.view(0).drones[0].state == "hovering"


def test_a_released_external_drone_is_commanded_to_hover(world: World):
    command(world, to_fly(world))
    assert world.control(ControlRequest("release", {"drone": "d2"}, ME)).ok
    hover = dict(world.take_outbox())[keys.accepted("d2", "ardrone")]
    assert hover == Ardrone(world.now_ns, 0, "world", 0.0, 0.0, 0.0, 0.0, hover=True)
    command(world, to_fly(world, seq=1))
    world.release_drones(ME)
    assert dict(world.take_outbox())[keys.accepted("d2", "ardrone")].seq == 1


def test_a_link_fault_delays_a_command(world: World):
    asked = {"kind": "link_delay", "target": f"{ME}/world", "delay_ms": 30, "for_s": 0.2}
    assert world.control(ControlRequest("fault_add", asked, "x")).ok
    world.advance(0)
    world.take_outbox()
    assert command(world, to_fly(world)) == []
    sent = []
    for _ in range(4):
        world.advance(0)
        sent.append(keys.accepted("d2", "velocity") in dict(world.take_outbox()))
    assert sent.count(True) == 1
    assert sent.index(True) == 2  # two gates later: the command is handed on before the third is integrated


@pytest.mark.parametrize("kind", ["gps_noise", "rotor_efficiency", "imu_dropout"])
def test_faults_of_an_external_drone_are_refused(world: World, kind: str):
    more = {"gps_noise": {"factor": 2}, "rotor_efficiency": {"rotor": "all", "value": 0.5}}.get(kind, {})
    answer = world.control(ControlRequest("fault_add", {"kind": kind, "target": "d2", **more}, "x"))
    assert has_terms(answer.error, "target", "'d2'", "external")
    assert world.control(ControlRequest("fault_add", {"kind": kind, "target": "d1", **more}, "x")).ok


def test_an_external_drone_is_in_the_views_but_not_in_gates_or_hash(world: World):
    pose = Truth(world.now_ns, 0, (4.0, 1.0, 2.0), ZEROS, (1.0, *ZEROS), ZEROS, ZEROS, (300.0,) * 4)
    world.accept_from_driver("d2", pose)
    world.advance(0)
    _, shown = world.view(0).drones
    assert (shown.position_m, shown.state, shown.battery_percent) == ((4.0, 1.0, 2.0), "hovering", 70.0)
    assert [drone.body for drone in world.info().drones] == [messages.UNSET, "external"]
    gates = [message for key, message in world.take_outbox() if key == keys.GATE]
    assert gates
    assert all(isinstance(gate, GateMessages) and {keys.thing(k) for k, _ in gate.pairs} == {"d1"} for gate in gates)
    moved = world_of()
    alone = world_of(MIXED.replace("body: external", "battery_percent: 50"))
    for each in (moved, alone):
        for _ in range(5):
            each.accept_from_driver("d2", pose) if each is moved else None
            each.advance(0)
    assert moved.result()["truth_sha256"] != alone.result()["truth_sha256"]


def test_the_result_has_the_shortest_distance_of_the_whole_run(world: World):
    for x_m in (4.0, 2.0, 3.0):
        pose = Truth(world.now_ns, 0, (x_m, 0.0, 0.058), ZEROS, (1.0, *ZEROS), ZEROS, ZEROS, (300.0,) * 4)
        assert world.accept_from_driver("d2", pose) is None
        world.advance(0)
    assert world.result()["closest_m"] == pytest.approx(2.0, abs=0.01)


def test_the_hash_covers_only_the_simulated_drones():
    only = world_of(MIXED.replace("  - {name: d2, position_m: [4, 0, 0], body: external}\n", ""), "lockstep")
    mixed = world_of()
    for _ in range(30):
        only.advance(0)
        mixed.advance(0)
    assert mixed.result()["truth_sha256"] == only.result()["truth_sha256"]


def test_estimators_of_an_external_drone_have_no_deadlines(world: World):
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


def test_a_continued_world_keeps_what_drivers_published(world: World):
    command(world, to_fly(world))
    other = world_of()
    continue_from(world, other)
    for each in (world, other):
        each.advance(0)
    published = dict(command(other, to_fly(other, seq=1)))
    assert published[keys.accepted("d2", "velocity")].seq == 1
    assert other.view(0) == world.view(0)


def test_lockstep_with_an_external_drone_is_refused_with_the_reason():
    with refused(ScenarioError, "mixed", "d2", "external", "lockstep", "--realtime"):
        world_of(mode="lockstep")


def test_an_emergency_reported_in_flight_is_an_event_once(world: World):
    for state in ("emergency", "emergency", "landed", "emergency"):
        assert world.accept_from_driver("d2", status(world.now_ns, state)) is None
    (event,) = [m for _, m in world.take_outbox() if isinstance(m, Event) and m.kind == "emergency"]
    assert (event.subject, event.data) == ("d2", {"cause": "driver"})
