"""A record as input of a rerun: the agents to run again, the inputs of each gate, and links to aircraft."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import synthetic_record
from refused import has_terms
from synthetic_pictures import image, info, sightings
from synthetic_record import Flown

from zsim import __version__
from zsim.contract import keys, messages
from zsim.contract.flight_messages import Estimate, LinkState, Mode, Truth
from zsim.contract.run_messages import Bye, Clock, ClusterRequest, Event, Health, Join
from zsim.record import RecordReader, RecordWriter
from zsim.scenario import scenario_file
from zsim.schema.message import Message
from zsim_analysis.reading.recorded_run import (
    AgentProcess,
    DriverLink,
    RecordedAgents,
    driver_links,
    gates,
    recorded_agents,
)
from zsim_analysis.report.comparison import ABSENT, ComparedRun, fact_rows
from zsim_analysis.report.make_report import facts
from zsim_analysis.report.summary import judge
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


# Agents to run again


def test_zsim_s_agents_are_run_again_with_their_requests(write: Any):
    key, end = keys.cluster_request("main"), event("end", "world", truth_sha256="abc")
    asked = [(key, ClusterRequest(gate * GATE_NS, gate, "hold", {}, "operator.pilot", True)) for gate in range(3)]
    found = agents(write(*reversed(OURS), join("recorder", ""), *asked, end))
    names = ("estimator.d1", "estimator.d2", "controller.main")
    assert found.processes == tuple(AgentProcess(name, (name,)) for name in names)
    assert (found.why_not, found.truth_sha256, found.fingerprints) == ("", "abc", {PRINT})
    assert list(found.requests) == asked


def test_a_process_that_served_others_serves_them_again(write: Any):
    found = agents(write(join("controller.main", serves=("estimator.d1", "estimator.d2"))))
    assert found.processes == (AgentProcess("controller.main", ("estimator.d1", "estimator.d2", "controller.main")),)
    assert has_terms(str(found.processes[0]), "controller.main", "estimator.d1", "estimator.d2")
    assert found.names == {"controller.main", "estimator.d1", "estimator.d2"}


@pytest.mark.parametrize("foreign", [join("estimator.d2", ""), join("estimator.d2", PRINT, version="")])
def test_foreign_processes_under_zsim_s_names_are_not_run_again(write: Any, foreign: RecordedEntry):
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
        (event("control", "fault_add", ok=True, args=KILL), ("process_kill", "0.10")),
    ],
)
def test_agents_are_not_run_again_after_a_disturbance(write: Any, entries: RecordedEntry, terms: tuple[str, ...]):
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
def test_irrelevant_events_do_not_prevent_running_agents_again(write: Any, entries: RecordedEntry):
    ends = (event("end", "world", gate=9), event("leave", "estimator.d1", gate=9))
    assert agents(write(*OURS, entries, *ends)).why_not == ""


def test_realtime_foreign_agents_and_planned_kills_prevent_a_rerun(write: Any):
    assert "realtime" in agents(write(*OURS), mode="realtime").why_not
    assert has_terms(agents(write(join("matlab.main"))).why_not, "none", "zsim's")
    scenario = scenario_file.from_text(f"{TEXT}faults: [{{kind: process_kill, target: estimator.d1, at_s: 0.5}}]")
    assert has_terms(recorded_agents(write(*OURS), INFO, scenario).why_not, "process_kill", "planned")


# Inputs of a rerun


def test_inputs_belong_to_the_gate_of_the_clock_that_follows_them(write: Any):
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
    assert list(gates(write(truth(0, "d1"), truth(0, "d2")), ["d1", "d2"])) == []  # there is no gate without its clock


def test_detections_are_inputs_and_pictures_are_not(write: Any) -> None:
    """Additional pictures in the record do not change a rerun."""
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


SECOND_NS = 1_000_000_000
PEER = "192.168.1.20:14580"
OVERRIDES = ("drones.drone3.body=external",)
REPORTS = [  # state, age, loss, round trip and refused, of two successive drivers
    [("waiting", None, None, None, 0), ("armed", 20.0, 1.0, 4.0, 3), ("lost", 1200.0, 1.0, 6.0, 3)],
    [("connected", 30.0, 4.0, 20.0, 2), ("armed", 10.0, None, None, 2)],
]


def record(path: Path, reports: list[list[tuple]] = REPORTS) -> Path:
    """Write a flight of 5 s with one external drone whose link is reported every second."""
    flown = Flown(duration_s=5.0, overrides=OVERRIDES)
    links = [(seq, *report) for driver in reports for seq, report in enumerate(driver)]
    with RecordWriter(path) as writer:
        for key, message, wall_ns in synthetic_record.traffic(flown):
            writer.add(key, messages.encode(message), messages.encoding(key), message.t_ns, wall_ns)
        for t_s, (seq, state, age, loss, trip, refused) in enumerate(links):
            link = LinkState(t_s * SECOND_NS, seq, "driver.drone3", PEER, state, age, loss, trip, None, refused)
            key = keys.link("drone3")
            writer.add(key, messages.encode(link), messages.encoding(key), link.t_ns, link.t_ns)
    return path


def test_a_link_is_summarised_over_all_drivers_of_its_drone(tmp_path: Path):
    (link,) = driver_links(record(tmp_path / "run.mcap")).values()
    assert link == DriverLink(PEER, 1200.0, 2.0, 4.0, 6.0, lost=1, lost_s=1.0, refused=5)
    unknown = driver_links(record(tmp_path / "unknown.mcap", [[("waiting", None, None, None, 0)]]))
    assert unknown == {"drone3": DriverLink(PEER, None, None, None, None, 0, 0.0, 0)}
    assert str(unknown["drone3"]).split(", ")[0] == PEER


@pytest.mark.parametrize(
    ("lost", "refused", "text"),
    [
        (0, 0, "never lost"),
        (1, 1, "lost once, for 1.5 s, 1 message refused"),
        (2, 5, "lost 2 times, for 1.5 s, 5 messages refused"),
    ],
)
def test_a_link_is_shown_with_its_losses_in_singular_or_plural(lost: int, refused: int, text: str):
    assert str(DriverLink(PEER, None, None, None, None, lost, 1.5, refused)) == f"{PEER}, {text}"


def test_a_run_with_a_link_can_be_compared_with_one_without(tmp_path: Path):
    directories = [tmp_path / name for name in ("simulated", "mixed")]
    for directory in directories:
        directory.mkdir()
    synthetic_record.write(directories[0] / "run.mcap", Flown(duration_s=1.0))
    record(directories[1] / "run.mcap")
    runs = [ComparedRun(d.name, d, *judge(d / "run.mcap")) for d in directories]
    assert [list(run.summary.links) for run in runs] == [[], ["drone3"]]
    assert [label for label, _ in facts(runs[1].summary) if "drone" in label] == ["Link of drone3"]
    assert driver_links(directories[0] / "run.mcap") == {}
    rows = fact_rows(runs)
    (link,) = (row.cells for row in rows if row.name == "Link of drone3")
    assert link[0] == ABSENT
    assert PEER in link[1]
