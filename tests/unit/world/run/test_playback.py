"""Playing a record as a run: which message belongs to which gate, what is played and what is refused."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from refused import has_terms, parts, refused
from synthetic_pictures import image, info, sightings

from zsim.contract import keys, messages
from zsim.contract.flight_messages import ClusterState, Estimate, Status, Truth, Velocity, ViewDrones
from zsim.contract.messages import Gps, Imu
from zsim.contract.run_messages import Bye, Clock, ControlRequest, Done, Event, Fault, Faults, Join
from zsim.errors import RecordError
from zsim.record import Recorded, RecordReader, RecordWriter
from zsim.scenario import scenario_file
from zsim.schema.message import Message
from zsim.sensors.camera import FrontCamera
from zsim_world.run.playback import MARKS_MAX, NOT_FLYABLE, RECORD_ENDED, Playback, PlaybackRange, RecordedGates
from zsim_world.run.world import World

GATE_NS = 20_000_000
ZEROS = (0.0, 0.0, 0.0)
SCENARIO = scenario_file.from_text("""
name: two
seed: 3
duration_s: 1
drones: [{name: d1, position_m: [0, 0, 0]}, {name: d2, position_m: [3, 0, 0]}]
clusters: [{name: main, drones: [d1, d2]}]
""")
INFO = World(SCENARIO, run_id="flown").info()
CMD = keys.command("d1", "velocity")
KeyedMessage = tuple[str, Message]


def clock(gate: int, state: Any = "running") -> KeyedMessage:
    return keys.CLOCK, Clock(gate * GATE_NS, gate, "flown", gate, state, 1.0)


def estimate(gate: int, drone: str = "d1", source: str = "") -> KeyedMessage:
    bare = Estimate(gate * GATE_NS, gate, ZEROS, ZEROS, (1.0, *ZEROS), 0.0, (0.5,) * 36, 0.1, ZEROS, {})
    return keys.estimate(drone), msgspec.structs.replace(bare, source=source)


def command(t_ns: int, source: str = "tester.one") -> KeyedMessage:
    return CMD, Velocity(t_ns, 0, source, ZEROS, 0.0)


def event(gate: int, kind: str, seq: int = 0) -> KeyedMessage:
    return keys.EVENT, Event(gate * GATE_NS, seq, kind, "world", "d1", kind)


def drone(gate: int, name: str) -> Iterator[KeyedMessage]:
    """Yield what the world publishes about a drone at a gate: an IMU sample before it, a fix at it, truth, status."""
    t_ns = gate * GATE_NS
    yield keys.sensor(name, "imu"), Imu(max(0, t_ns - 5_000_000), gate, t_ns, ZEROS, ZEROS)
    yield keys.sensor(name, "gps"), Gps(t_ns, gate, t_ns, 0.0, 0.0, 0.0, (float(gate), 0.0, 0.0), ZEROS, 2.0, 3, 9)
    yield (
        keys.truth(name),
        Truth(t_ns, gate, (float(gate), 0.0, 1.0), ZEROS, (1.0, *ZEROS), ZEROS, ZEROS, (9.0, 9.0, 9.0, 9.0)),
    )
    yield keys.status(name), Status(t_ns, gate, "flying", 50.0, False, None, 3)


def gate(number: int) -> list[KeyedMessage]:
    return [*drone(number, "d1"), *drone(number, "d2"), clock(number)]


def write(folder: Path, recorded: list[KeyedMessage]) -> RecordReader:
    path = folder / "run.mcap"
    with RecordWriter(path) as writer:
        for place, (key, message) in enumerate(recorded):
            writer.add_message(key, message, 1_000_000 * place)
    return RecordReader(path)


@pytest.fixture
def flight(tmp_path: Path) -> Iterator[RecordReader]:
    """Ten gates; the estimators answer one gate late, the controller two."""
    recorded: list[KeyedMessage] = [(keys.INFO, INFO), event(0, "join"), clock(0, "waiting")]
    join = Join(0, 0, "flown", 1, "estimator", "h", 1, GATE_NS)
    recorded += [(keys.process("estimator.d1", "join"), join)]
    state = ClusterState(0, 0, "engaged", (), (), (), (), (), None, 1.0, "")
    for number in range(10):
        recorded += gate(number)
        recorded += [estimate(number), estimate(number, "d2")]
        recorded += [(keys.process("estimator.d1", "done"), Done(0, number, "flown", 1, number * GATE_NS, 1))]
        recorded += [(keys.VIEW_DRONES, ViewDrones(number * GATE_NS, number, (), ((1.0, 0.0, 0.0), (2.0, 0.0, 0.0))))]
        recorded += [command(max(0, number - 1) * GATE_NS, "controller.main")]
        recorded += [(keys.cluster_state("main"), msgspec.structs.replace(state, t_ns=number * GATE_NS, seq=number))]
    recorded += [event(9, "end", 1), clock(9, "stopped"), (keys.process("estimator.d1", "bye"), Bye(0, 0, "over"))]
    with write(tmp_path, recorded) as reader:
        yield reader


def playback(reader: RecordReader, **choice: Any) -> Playback:
    return Playback(reader, SCENARIO, INFO, PlaybackRange(**choice), 0.0, lambda: 0, "replay")


def played(made: Playback) -> list[tuple[str, bytes]]:
    """Play to the end; return key and payload of everything published."""
    published: list[tuple[str, bytes]] = []
    while made.may_advance():
        made.advance(0)
        for key, message in made.take_outbox():
            published += message.pairs if key == keys.GATE else [(key, messages.encode(message))]
    return published


def on(key: str, published: list[tuple[str, bytes]]) -> list[Any]:
    return [messages.decode(name, payload) for name, payload in published if name == key]


# Which message belongs to which gate


def gates_of(recorded: list[KeyedMessage], tmp_path: Path, delay_gates: int = 1) -> dict[int, list[tuple[str, int]]]:
    """Return (key, t_ns) of what is played with each gate."""
    with write(tmp_path, recorded) as reader:
        gates = RecordedGates(reader, GATE_NS, delay_gates * GATE_NS, set(reader.topics())).gates()
        return {g.t_ns // GATE_NS: [(m.key, m.t_ns) for m in g.messages] for g in gates}


@pytest.mark.parametrize("late", [0, 1, 2, 4])
def test_an_answer_belongs_to_its_gate_however_far_the_world_ran_ahead(late: int, tmp_path: Path):
    recorded = [clock(0)]
    for number in range(1, 20):
        recorded += [clock(number), *([estimate(number - 1 - late)] if number > late else [])]
    gates = gates_of(recorded, tmp_path, delay_gates=5)
    for number in range(18 - late):
        assert gates[number] == [(keys.estimate("d1"), number * GATE_NS)]


def test_a_meaningless_time_stamp_does_not_move_a_message(tmp_path: Path):
    recorded = [message for number in range(10) for message in (clock(number), command(0), command(10**15))]
    gates = gates_of(recorded, tmp_path)
    assert gates[0] == gates[1] == [] or gates[0][0] == (CMD, 0)
    # written after the clock of gate k, they are played with gate k + 1, except where stamp 0 may be an answer's
    assert [len(gates[number]) for number in range(4, 10)] == [2] * 6
    assert sum(map(len, gates.values())) == 18  # what follows the last clock belongs to no gate


def test_sensor_data_between_two_gates_belong_to_the_second(tmp_path: Path):
    gates = gates_of([message for number in range(4) for message in gate(number)], tmp_path)
    assert [len(gates[number]) for number in range(4)] == [8] * 4
    assert (keys.sensor("d2", "imu"), 2 * GATE_NS - 5_000_000) in gates[2]


def test_clocks_of_a_halted_run_are_not_gates(tmp_path: Path):
    recorded = [clock(0, "waiting"), clock(0, "waiting"), *gate(0), clock(0, "paused"), *gate(1), clock(1, "stopped")]
    assert [*gates_of(recorded, tmp_path)] == [0, 1]


def test_an_incomplete_gate_is_not_played(tmp_path: Path):
    recorded = [*gate(0), *gate(1), *[*drone(2, "d1")]]
    assert [*gates_of(recorded, tmp_path)] == [0, 1]


def test_the_record_is_read_only_a_few_gates_ahead(tmp_path: Path):
    with write(tmp_path, [message for number in range(1000) for message in gate(number)]) as reader:
        read: list[Recorded] = []

        class Counted:
            def messages(self, *args: Any, **options: Any) -> Iterator[Recorded]:
                for recorded in reader.messages(*args, **options):
                    read.append(recorded)
                    yield recorded

        counted: Any = Counted()
        gates = RecordedGates(counted, GATE_NS, GATE_NS, set(reader.topics())).gates()
        for number in range(500):
            assert next(gates).t_ns == number * GATE_NS
            assert len(read) <= 9 * (number + 3)


# What is played


def test_everything_but_process_messages_and_views_is_played(flight: RecordReader):
    published = played(playback(flight))
    again = ("drone/d1/sensor/imu", "drone/d2/truth", "drone/d1/sensor/status", "drone/d2/estimate", CMD)
    for key in (*again, "cluster/main/state"):
        recorded = [m.payload for m in flight.messages([key])]
        assert [payload for name, payload in published if name == key] == recorded, key
    assert not [key for key, _ in published if key.startswith(("process/", "view/")) or key == keys.INFO]
    clocks = on(keys.CLOCK, published)
    assert [c.t_ns // GATE_NS for c in clocks] == list(range(10))
    assert [c.seq for c in clocks] == list(range(10))
    assert {c.run_id for c in clocks} == {"replay"}
    assert [e.kind for e in on(keys.EVENT, published)] == ["join"]  # its own end is published by publish_end


def test_info_and_end_name_the_played_run(flight: RecordReader):
    made = playback(flight, to_ns=5 * GATE_NS)
    info = made.info()
    assert (info.run_id, info.replay_of, info.mode, info.rate) == ("replay", "flown", "lockstep", 0.0)
    assert info.scenario_sha256 == INFO.scenario_sha256
    published = played(made)
    assert on(keys.CLOCK, published)[-1].t_ns == 5 * GATE_NS
    made.publish_end()
    (_, end), (_, last) = made.take_outbox()
    assert (end.kind, end.data["replay_of"], end.data["last_ns"]) == ("end", "flown", 5 * GATE_NS)
    assert end.seq == 1  # after the recorded join
    assert last.state == "stopped"
    assert has_terms(made.ended or "", "0.1")


def test_a_part_of_a_record_can_be_played(flight: RecordReader):
    made = playback(flight, from_ns=4 * GATE_NS - 1, keys=("drone/*/truth", "drone/d1/sensor/*"), paused=True)
    assert made.clock.next_ns == 4 * GATE_NS
    made.advance(0)
    assert made.clock.state == "paused"
    assert not made.may_advance()
    assert made.control(ControlRequest("resume")).ok
    published = played(made)
    assert {key for key, _ in published} >= {"drone/d1/truth", "drone/d2/truth", "drone/d1/sensor/imu"}
    assert not [
        key for key, _ in published if key.startswith(("drone/d2/sensor", "cluster")) or key.endswith("estimate")
    ]


def test_the_status_counts_the_messages_played(flight: RecordReader):
    whole = on(keys.status("d1"), played(playback(flight)))
    part = on(keys.status("d1"), played(playback(flight, keys=("drone/*/sensor/imu", "drone/*/sensor/status"))))
    assert {status.count for status in whole} == {3}
    assert part == [msgspec.structs.replace(status, count=2) for status in whole]


def test_gates_are_bundled_as_by_the_world(flight: RecordReader):
    made = playback(flight)
    made.advance(0)
    made.take_outbox()
    made.advance(0)
    gate = next(message for key, message in made.take_outbox() if key == keys.GATE)
    gate.check()
    assert (gate.t_ns, gate.seq, gate.first) == (GATE_NS, 1, [0, 4, 8])
    assert gate.stamps.tolist() == [15_000_000, GATE_NS, GATE_NS, GATE_NS] * 2
    assert [key for key, _ in gate.pairs][3::4] == [keys.status("d1"), keys.status("d2")]


def test_views_show_what_was_played(flight: RecordReader):
    made = playback(flight)
    played(made)
    views = {output.key: output.message for output in made.views(7)}
    assert set(views) == {
        "view/drones",
        "view/cluster/main",
        "view/estimates/estimator.d1",
        "view/estimates/estimator.d2",
    }
    shown: Any = views["view/drones"]
    assert [(d.name, d.position_m, d.state) for d in shown.drones] == [
        ("d1", (9.0, 0.0, 1.0), "flying"),
        ("d2", (9.0, 0.0, 1.0), "flying"),
    ]
    assert shown.wind_m_s == ((1.0, 0.0, 0.0), (2.0, 0.0, 0.0))
    for key, message in views.items():
        assert messages.decode(key, messages.encode(message)) == message


# Participants


def join(made: Playback, name: str, period_ns: int = GATE_NS, serves: tuple[str, ...] = ()) -> None:
    role = name.split(".")[0]
    made.handle(keys.process(name, "join"), Join(0, 0, "replay", 5, role, "h", 1, period_ns, serves=serves), 0)


def test_a_participant_is_waited_for_and_replaces_its_record(flight: RecordReader):
    made = playback(flight)
    made.barrier.expect("estimator.d1")
    assert not made.may_advance()
    join(made, "estimator.d1")
    published = []
    for number in range(10):
        assert made.may_advance()
        made.advance(0)
        published += [(key, message) for key, message in made.take_outbox() if key != keys.GATE]
        if 0 < number < 9:  # the replay is a gate ahead, as a world is
            assert not made.may_advance()
            done = Done(0, number, "replay", 5, (number - 1) * GATE_NS, 0)
            made.handle(keys.process("estimator.d1", "done"), done, 0)
    estimates = [key for key, _ in published if key.endswith("/estimate")]
    assert estimates == [keys.estimate("d2")] * 10
    assert "view/estimates/estimator.d1" not in [output.key for output in made.views(0)]


def test_a_death_or_departure_does_not_end_the_replay(flight: RecordReader):
    made = playback(flight)
    join(made, "recorder", 0)
    join(made, "estimator.d1")
    made.died("estimator.d1", 0)
    made.handle(keys.process("recorder", "bye"), Bye(0, 0, "enough"), 0)
    assert len(on(keys.CLOCK, played(made))) == 10
    assert made.ended == RECORD_ENDED


def test_commands_and_control_of_drones_are_refused(flight: RecordReader):
    made = playback(flight)
    made.handle(CMD, Velocity(0, 0, "tester.one", ZEROS, 0.0), 0)
    (_, refused) = made.take_outbox()[-1]
    assert (refused.kind, refused.source, refused.data["reason"]) == ("refused", "tester.one", NOT_FLYABLE)
    for op in ("acquire", "release", "fault_add", "fault_clear"):
        assert made.control(ControlRequest(op, {"drone": "d1"}, "tester.one")).error == NOT_FLYABLE
    assert made.refused_queries == ("cluster/main/control",)
    assert made.refusal_at("cluster/main/control") == NOT_FLYABLE
    join(made, "controller.main")
    assert made.refusal_at("cluster/main/control") is None


def test_seek_jumps_to_a_gate_and_refuses_invalid_times(flight: RecordReader):
    made = playback(flight)
    made.advance(0)
    assert made.control(ControlRequest("seek", {"t_s": 0.12})).ok
    assert (made.clock.next_ns, made.clock.jumps) == (6 * GATE_NS, 1)
    made.advance(0)
    assert made.now_ns == 6 * GATE_NS
    for t_s in (5, -1, "noon", True, None, float("nan"), float("inf"), 1e300):
        assert parts(made.control(ControlRequest("seek", {"t_s": t_s})).error) == ("t_s", repr(t_s))
    assert made.clock.next_ns == 7 * GATE_NS
    assert made.control(ControlRequest("seek", {"t_s": 0})).ok
    assert made.clock.next_ns == 0
    join(made, "estimator.d1")
    assert has_terms(made.control(ControlRequest("seek", {"t_s": 0.1})).error, "estimator.d1", "lockstep")


def faults_message(number: int, *kinds: str) -> KeyedMessage:
    """Return the world's list of the faults that are active from a gate on."""
    all_ = tuple(Fault(i, kind, "d1", {}, 0, None, "tester.one") for i, kind in enumerate(kinds))
    return keys.FAULTS, Faults(number * GATE_NS, number, all_)


@pytest.fixture
def faulty(tmp_path: Path) -> Iterator[RecordReader]:
    """Six gates; a fault is active from the fourth on."""
    recorded: list[KeyedMessage] = [(keys.INFO, INFO), *gate(0), *gate(1), *gate(2), faults_message(3, "gps_dropout")]
    recorded += [message for number in range(3, 6) for message in gate(number)]
    with write(tmp_path, recorded) as reader:
        yield reader


def test_a_holding_replay_pauses_at_its_end_and_can_seek_back(flight: RecordReader):
    held = Playback(flight, SCENARIO, INFO, PlaybackRange(holds=True))
    for _ in range(1000):
        if held.clock.is_halted:
            break
        held.advance(0)
    assert held.clock.state == "paused"
    assert held.ended is None
    end_ns = held.now_ns
    held.clock.state = "running"
    held.advance(0)
    assert (held.now_ns, held.clock.state) == (end_ns, "paused")
    assert held.control(ControlRequest("seek", {"t_s": 0.0})).ok
    held.advance(0)
    assert held.now_ns < end_ns


def test_views_of_any_part_are_answered_wherever_the_replay_is(flight: RecordReader):
    made = playback(flight)
    played(made)
    args = {"from_s": 0.04, "to_s": 0.16, "every_s": 0.04}
    before = made.requests, len(made.take_outbox())
    answer = made.control(ControlRequest("views", args, "console.1"))
    assert answer.ok
    views = [messages.decode(key, payload) for key, payload in answer.result if key == keys.VIEW_DRONES]
    assert [view.t_ns // GATE_NS for view in views] == [2, 4, 6, 8]
    assert [view.drones[0].position_m[0] for view in views] == [2.0, 4.0, 6.0, 8.0]
    clusters = [messages.decode(key, payload) for key, payload in answer.result if key == keys.cluster_view("main")]
    assert [view.t_ns // GATE_NS for view in clusters] == [2, 4, 6, 8]
    assert len([key for key, _ in answer.result if key == keys.estimates_view("estimator.d2")]) == 4
    assert (made.requests, len(made.take_outbox())) == before  # no event, since views are requested again and again


@pytest.mark.parametrize(
    ("args", "found"),
    [
        ({}, ("from_s", "None")),
        ({"from_s": -1.0, "to_s": 1.0, "every_s": 0.1}, ("from_s", "-1.0")),
        ({"from_s": 0.0, "to_s": 1e6, "every_s": 0.1}, ("to_s", "1000000.0")),
        ({"from_s": 0.0, "to_s": 1.0, "every_s": 0}, ("every_s", "0")),
        ({"from_s": 0.0, "to_s": 50.0, "every_s": 1e-6}, ("every_s", "1e-06")),
    ],
)
def test_views_of_an_invalid_range_are_refused(flight: RecordReader, args: dict[str, Any], found: tuple[str, str]):
    answer = playback(flight).control(ControlRequest("views", args))
    assert not answer.ok
    assert parts(answer.error) == found


def test_there_are_no_views_beyond_the_record(flight: RecordReader):
    answer = playback(flight).control(ControlRequest("views", {"from_s": 0.1, "to_s": 30.0, "every_s": 0.1}))
    assert {messages.decode(key, payload).t_ns for key, payload in answer.result} <= {100_000_000, 200_000_000}


def test_a_timeline_has_both_ends_of_the_record_and_selected_events(tmp_path: Path):
    many = [event(1, "death"), event(1, "command", 1), *(event(k // 10, "control", k) for k in range(20, 1000))]
    with write(tmp_path, [*gate(0), *many, *gate(99)]) as reader:
        answer = Playback(reader, SCENARIO, INFO).control(ControlRequest("timeline"))
    assert answer.ok
    assert (answer.result["from_s"], answer.result["to_s"]) == (0.0, 99 * GATE_NS / 1e9)
    marks = answer.result["marks"]
    assert (marks[0]["t_s"], marks[0]["kind"]) == (GATE_NS / 1e9, "death")
    assert 1 < len(marks) <= MARKS_MAX
    assert {mark["kind"] for mark in marks} == {"death", "control"}
    assert marks[-1]["t_s"] > 0.9 * 99 * GATE_NS / 1e9


def test_a_refused_seek_changes_nothing(faulty: RecordReader):
    made = playback(faulty)
    made.advance(0)
    assert parts(made.control(ControlRequest("seek", {"t_s": 5})).error) == ("t_s", "5")
    made.take_outbox()
    made.advance(0)
    assert keys.FAULTS not in [key for key, _ in made.take_outbox()]


def test_a_seek_back_leaves_nothing_of_the_future(faulty: RecordReader):
    made = playback(faulty)
    for _ in range(5):
        made.advance(0)
    assert made.views(0)
    made.take_outbox()
    assert made.control(ControlRequest("seek", {"t_s": 0.02})).ok
    assert not made.views(0)
    made.advance(0)
    faults = [messages.decode(key, messages.encode(m)) for key, m in made.take_outbox() if key == keys.FAULTS]
    assert [(listed.t_ns, listed.faults) for listed in faults] == [(GATE_NS, ())]


def test_the_result_measures_what_was_played(flight: RecordReader):
    """Gates 6 to 8, then 1 to 3, one every 10 ms."""
    made = playback(flight, from_ns=6 * GATE_NS)
    for number in range(6):
        if number == 3:
            assert made.control(ControlRequest("seek", {"t_s": 0.02})).ok
        made.advance(number * 10_000_000)
    result = made.result()
    assert (result["sim_s"], result["wall_s"]) == (4 * GATE_NS / 1e9, 0.05)
    assert result["last_ns"] == 3 * GATE_NS


@pytest.mark.parametrize(("from_ns", "to_ns"), [(GATE_NS + 1, GATE_NS + 2), (0, -1), (7_000_000_000, None)])
def test_a_range_without_gates_is_refused(flight: RecordReader, from_ns: int, to_ns: int | None):
    until = [] if to_ns is None else [f"{to_ns / 1e9:.12g}"]
    with refused(RecordError, "run.mcap", "gate", f"{from_ns / 1e9:.12g}", *until):
        playback(flight, from_ns=from_ns, to_ns=to_ns)


def test_active_faults_are_published_before_the_first_gate(tmp_path: Path):
    recorded: list[KeyedMessage] = [(keys.INFO, INFO), faults_message(0), *gate(0), *gate(1)]
    recorded += [faults_message(1, "gps_dropout"), *gate(2), *gate(3)]
    with write(tmp_path, recorded) as reader:
        whole, late = played(playback(reader)), played(playback(reader, from_ns=3 * GATE_NS))
    assert [len(listed.faults) for listed in on(keys.FAULTS, whole)] == [0, 1]
    assert [listed.faults[0].kind for listed in on(keys.FAULTS, late)] == ["gps_dropout"]
    assert [key for key, _ in late].index(keys.FAULTS) == 0


def test_a_recorded_kill_does_not_kill_a_participant(tmp_path: Path):
    """The other faults in the list stay as recorded; a list without a kill is identical to the byte."""
    cut = Fault(1, "gps_dropout", "d1", {}, 0, None, "tester.one")
    kill = Fault(2, "process_kill", "estimator.d1", {}, GATE_NS, None, "tester.one")
    recorded: list[KeyedMessage] = [(keys.INFO, INFO)]
    for number, faults in enumerate(((cut,), (cut, kill), (kill,))):
        recorded += [(keys.FAULTS, Faults(number * GATE_NS, number, faults)), *gate(number)]
    with write(tmp_path, [*recorded, *gate(3)]) as reader:
        whole, late = played(playback(reader)), played(playback(reader, from_ns=3 * GATE_NS))
    assert [listed.faults for listed in on(keys.FAULTS, whole)] == [(cut,), (cut,), ()]
    assert [listed.seq for listed in on(keys.FAULTS, whole)] == [0, 1, 2]
    assert [listed.faults for listed in on(keys.FAULTS, late)] == [()]
    assert next(payload for key, payload in whole if key == keys.FAULTS) == messages.encode(recorded[1][1])


# Cameras

FRONT, FRONT_INFO, DETECTIONS = keys.camera("d1", "front"), keys.camera_info("d1", "front"), keys.detections("d1")


@pytest.fixture
def filmed(tmp_path: Path) -> Iterator[RecordReader]:
    """Six gates, each with a picture and its detections; the camera info was published once, at the start."""
    recorded: list[KeyedMessage] = [(keys.INFO, INFO), (FRONT_INFO, info(0))]
    for number in range(6):
        t_ns = number * GATE_NS
        recorded += [*gate(number), (FRONT, image(t_ns, number)), (DETECTIONS, sightings(t_ns, number))]
    with write(tmp_path, recorded) as reader:
        yield reader


def test_pictures_are_played_as_recorded_each_with_its_gate(filmed: RecordReader):
    published = played(playback(filmed))
    assert [payload for key, payload in published if key == FRONT] == [
        messages.encode(image(number * GATE_NS, number)) for number in range(6)
    ]
    newest, gates_of_pictures = -1, []
    for key, payload in published:
        newest = messages.decode(key, payload).t_ns if key == keys.CLOCK else newest
        gates_of_pictures += [newest] if key == FRONT else []
    assert gates_of_pictures == [number * GATE_NS for number in range(6)]
    assert on(DETECTIONS, published) == [sightings(number * GATE_NS, number) for number in range(6)]


def test_camera_info_is_published_even_if_the_replay_starts_later(filmed: RecordReader):
    assert on(FRONT_INFO, played(playback(filmed))) == [info(0)]
    assert on(FRONT_INFO, played(playback(filmed, from_ns=3 * GATE_NS))) == [info(0)]
    published = played(playback(filmed, from_ns=3 * GATE_NS, keys=("drone/*/truth",)))
    assert (on(FRONT_INFO, published), on(FRONT, published)) == ([], [])
    assert len(on(keys.truth("d1"), published)) == 3


def test_a_participating_camera_replaces_the_recorded_pictures(filmed: RecordReader):
    made = playback(filmed)
    join(made, "camera.d1", 0)
    published = played(made)
    assert (on(FRONT, published), on(FRONT_INFO, published)) == ([], [])
    assert len(on(DETECTIONS, published)) == 6  # the recorded detections are kept


@pytest.fixture
def filmed_by_one(tmp_path: Path) -> Iterator[RecordReader]:
    """One gate with pictures and detections of both drones, from one camera and one detector for both."""
    recorded: list[KeyedMessage] = [(keys.INFO, INFO), *gate(0)]
    for name in ("d1", "d2"):
        recorded += [(keys.camera_info(name, "front"), info(0, source="camera.main"))]
        recorded += [(keys.camera(name, "front"), image(0, source="camera.main"))]
        recorded += [(keys.detections(name), sightings(0, source="detector.main"))]
    with write(tmp_path, recorded) as reader:
        yield reader


# name: (process, processes it declares to serve, drones whose pictures are played, drones whose detections are)
ANEW = {
    "one of them": ("camera.d2", (), ["d1"], ["d1", "d2"]),
    "one of them, in the name of both": ("camera.main", ("camera.d2",), ["d1"], ["d1", "d2"]),
    "both": ("camera.main", ("camera.d1", "camera.d2"), [], ["d1", "d2"]),
    "a detector": ("detector.d1", (), ["d1", "d2"], ["d2"]),
    "a name alone": ("camera.main", (), [], ["d1", "d2"]),
    "another name alone": ("camera.other", (), ["d1", "d2"], ["d1", "d2"]),
}


@pytest.mark.parametrize("name", ANEW)
def test_a_camera_replaces_the_recorded_pictures_of_its_drones(filmed_by_one: RecordReader, name: str):
    process, serves, pictures, seen = ANEW[name]
    made = playback(filmed_by_one)
    join(made, process, 0, serves)
    published = [key for key, _ in played(made)]
    assert [d for d in ("d1", "d2") if keys.camera(d, "front") in published] == pictures
    assert [d for d in ("d1", "d2") if keys.camera_info(d, "front") in published] == pictures
    assert [d for d in ("d1", "d2") if keys.detections(d) in published] == seen


def test_recorded_cameras_missing_from_the_scenario_are_not_replaced(tmp_path: Path):
    bottom = keys.camera("d1", "bottom")
    first, second = SCENARIO.drones
    sensors = msgspec.structs.replace(first.sensors, front_camera=FrontCamera())
    scenario = msgspec.structs.replace(SCENARIO, drones=[msgspec.structs.replace(first, sensors=sensors), second])
    with write(
        tmp_path, [(keys.INFO, INFO), *gate(0), (FRONT, image(0)), (bottom, image(0, source="own.eye"))]
    ) as reader:
        made = Playback(reader, scenario, INFO, PlaybackRange(), 0.0, lambda: 0, "replay")
        join(made, "camera.d1", 0)
        published = played(made)
    assert (len(on(FRONT, published)), len(on(bottom, published))) == (0, 1)
