"""A record as inputs: which agents are run again, and what reached the world before each gate."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from refused import has_terms
from synthetic_pictures import image, info, sightings

from zsim import __version__
from zsim.contract import keys, messages
from zsim.contract.flight_messages import Estimate, Mode, Truth
from zsim.contract.run_messages import Bye, Clock, ClusterRequest, Event, Health, Join
from zsim.record import RecordReader, RecordWriter
from zsim.scenario import scenario_file
from zsim.schema.message import Message
from zsim_analysis.reading.recorded_run import AgentProcess, RecordedAgents, gates, recorded_agents
from zsim_world.run.world import World

GATE_NS = 20_000_000
PRINT = "f" * 16
ZEROS = (0.0, 0.0, 0.0)
TEXT = """
name: two
seed: 3
duration_s: 1
drones: [{name: d1, position_m: [0, 0, 0]}, {name: d2, position_m: [3, 0, 0]}]
clusters: [{name: main, drones: [d1, d2]}]
"""
SCENARIO = scenario_file.from_text(TEXT)
INFO = World(SCENARIO, run_id="flown").info()
KILL = {"kind": "process_kill", "target": "estimator.d1"}
RecordedEntry = tuple[str, Message]


def join(
    name: str, fingerprint: str = PRINT, serves: tuple[str, ...] = (), version: str = __version__
) -> RecordedEntry:
    role = name.partition(".")[0]
    message = Join(0, 0, "flown", 1, role, "h", 1, GATE_NS, version, fingerprint, serves)
    return keys.process(name, "join"), message


def event(kind: str, subject: str, gate: int = 5, **data: Any) -> RecordedEntry:
    return keys.EVENT, Event(gate * GATE_NS, 0, kind, "world", subject, kind, data)


def truth(gate: int, drone: str, x: float = 0.0) -> RecordedEntry:
    message = Truth(gate * GATE_NS, gate, (x, 0.0, 1.0), ZEROS, (1.0, *ZEROS), ZEROS, ZEROS, (9.0, 9.0, 9.0, 9.0))
    return keys.truth(drone), message


def clock(gate: int, state: Any = "running") -> RecordedEntry:
    return keys.CLOCK, Clock(gate * GATE_NS, gate, "flown", gate, state, 1.0)


@pytest.fixture
def write(tmp_path: Path) -> Iterator[Any]:
    readers: list[RecordReader] = []

    def write(*entries: RecordedEntry) -> RecordReader:
        path = tmp_path / f"{len(readers)}.mcap"
        with RecordWriter(path) as writer:
            for place, (key, message) in enumerate(entries):
                writer.add_message(key, message, place)
        readers.append(RecordReader(path))
        return readers[-1]

    yield write
    for reader in readers:
        reader.close()


OURS = (join("estimator.d1"), join("estimator.d2"), join("controller.main"))


def agents(reader: RecordReader, **info: Any) -> RecordedAgents:
    return recorded_agents(reader, msgspec.structs.replace(INFO, **info), SCENARIO)


# Who is run again


def test_our_agents_are_run_again_by_their_processes(write: Any):
    found = agents(write(*reversed(OURS), join("recorder", ""), event("end", "world", truth_sha256="abc")))
    assert found.processes == (
        AgentProcess("estimator.d1", ("estimator.d1",)),
        AgentProcess("estimator.d2", ("estimator.d2",)),
        AgentProcess("controller.main", ("controller.main",)),
    )
    assert (found.why_not, found.truth_sha256, found.fingerprints) == ("", "abc", {PRINT})


def test_who_served_others_does_so_again(write: Any):
    found = agents(write(join("controller.main", serves=("estimator.d1", "estimator.d2"))))
    assert found.processes == (AgentProcess("controller.main", ("estimator.d1", "estimator.d2", "controller.main")),)
    assert has_terms(str(found.processes[0]), "controller.main", "estimator.d1", "estimator.d2")
    assert found.names == {"controller.main", "estimator.d1", "estimator.d2"}


@pytest.mark.parametrize("foreign", [join("estimator.d2", ""), join("estimator.d2", PRINT, version="")])
def test_others_under_our_names_are_not(write: Any, foreign: RecordedEntry):
    found = agents(write(join("estimator.d1"), foreign, join("matlab.main"), join("controller.other")))
    assert [process.name for process in found.processes] == ["estimator.d1"]


@pytest.mark.parametrize(
    ("entries", "terms"),
    [
        (event("death", "estimator.d1"), ("death", "estimator.d1", "0.10")),
        (event("superseded", "controller.main"), ("superseded", "controller.main", "0.10")),
        (event("leave", "estimator.d2"), ("leave", "estimator.d2", "0.10")),
        (event("outputs_missing", "estimator.d2"), ("outputs", "estimator.d2", "0.10")),
        (event("join", "estimator.d2", from_ns=GATE_NS), ("estimator.d2", "joined", "0.10")),
        (event("control", "fault_add", ok=True, args=KILL), ("process_kill", "asked", "0.10")),
    ],
)
def test_why_agents_are_not_run_again(write: Any, entries: RecordedEntry, terms: tuple[str, ...]):
    found = agents(write(*OURS, entries, event("end", "world", gate=9)))
    assert found.processes == ()
    assert has_terms(found.why_not, *terms)


@pytest.mark.parametrize(
    "entries",
    [
        event("death", "operator.pilot"),
        event("leave", "matlab.main"),
        event("join", "estimator.d2", from_ns=0),
        event("control", "fault_add", ok=False, args=KILL),
    ],
)
def test_what_is_no_reason(write: Any, entries: RecordedEntry):
    assert (
        agents(write(*OURS, entries, event("end", "world", gate=9), event("leave", "estimator.d1", gate=9))).why_not
        == ""
    )


def test_a_run_in_realtime_or_without_ours_has_a_reason(write: Any):
    assert "realtime" in agents(write(*OURS), mode="realtime").why_not
    assert has_terms(agents(write(join("matlab.main"))).why_not, "none", "zsim's")


def test_a_kill_in_the_scenario_is_a_reason(write: Any):
    scenario = scenario_file.from_text(f"{TEXT}faults: [{{kind: process_kill, target: estimator.d1, at_s: 0.5}}]")
    assert has_terms(recorded_agents(write(*OURS), INFO, scenario).why_not, "process_kill", "planned")


def test_requests_are_kept_in_their_order(write: Any):
    key = keys.cluster_request("main")
    asked = [(key, ClusterRequest(gate * GATE_NS, gate, "hold", {}, "operator.pilot", True)) for gate in range(3)]
    assert list(agents(write(*OURS, *asked)).requests) == asked


# What is fed


def test_inputs_count_before_the_clock_that_follows_them(write: Any):
    mode = (keys.command("d1", "mode"), Mode(0, 0, "tester.one", "takeoff"))
    estimate = Estimate(0, 0, ZEROS, ZEROS, (1.0, *ZEROS), 0.0, (0.0,) * 36, 0.1, ZEROS, {})
    health = (keys.process("recorder", "health"), Health(0, 0, "recorder", "h", 1, {}, 0, 0, 0, 0))
    reader = write(
        clock(0, "waiting"), join("tester.one"), truth(0, "d1"), truth(0, "d2"), clock(0), mode, health, clock(0, "paused"),
        (keys.estimate("d1"), estimate), truth(1, "d1"), truth(1, "d2"), clock(1), clock(1, "stopped"),
        (keys.process("tester.one", "bye"), Bye(0, 0, "over")),
    )  # fmt: skip
    first, second = gates(reader, ["d1", "d2"])
    assert (first.t_ns, [m.key for m in first.inputs]) == (0, ["process/tester.one/join"])
    assert (second.t_ns, [m.key for m in second.inputs]) == (GATE_NS, [mode[0], keys.estimate("d1")])
    assert first.truth == {drone: messages.encode(truth(0, drone)[1]) for drone in ("d1", "d2")}


def test_a_gate_without_its_clock_is_no_passage(write: Any):
    assert list(gates(write(truth(0, "d1"), truth(0, "d2")), ["d1", "d2"])) == []


def test_pictures_are_no_inputs_and_what_detectors_saw_is(write: Any) -> None:
    """A picture more or less on record changes nothing that is flown again."""
    pictures: list[RecordedEntry] = [(keys.camera_info("d1", "front"), info())]
    pictures += [(keys.camera("d1", "front"), image(gate * GATE_NS, gate)) for gate in range(3)]
    detected: RecordedEntry = (keys.detections("d1"), sightings(GATE_NS))
    flown = [entry for gate in range(3) for entry in (truth(gate, "d1"), truth(gate, "d2"), clock(gate))]
    with_pictures = write((keys.INFO, INFO), *pictures[:2], *flown[:3], *pictures[2:], detected, *flown[3:])
    bare = write((keys.INFO, INFO), *flown[:3], detected, *flown[3:])
    found, same = (
        [(g.t_ns, [(m.key, m.payload) for m in g.inputs], g.truth) for g in gates(reader, ["d1", "d2"])]
        for reader in (with_pictures, bare)
    )
    assert found == same
    assert [[key for key, _ in inputs] for _, inputs, _ in found] == [[], [keys.detections("d1")], []]
