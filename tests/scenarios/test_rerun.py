"""A run is flown again from its record, to the same bits whoever took part; a line reports any difference."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import msgpack
import pytest
from federation import ONE, PAIR, Federation
from forked_commands import ROOT, run_here
from mcap.opcode import Opcode
from wire import PATIENCE_S

from zsim.record import RecordReader, RecordWriter
from zsim.record.mcap_layout import record_spans

PILOT = "operator.pilot"
PLAIN = ROOT / "examples" / "plain_client.py"


class Printed(str):
    """The output of a command."""

    def line(self, pattern: str) -> None:
        assert re.search(pattern, self, re.MULTILINE), self


def rerun(federation: Federation, *options: str, code: int = 0, of: Path | None = None) -> Printed:
    """Rerun the recorded run; return what the command prints."""
    done = run_here("rerun", str(of or federation.out), *options)
    assert done.code == code, done
    return Printed(done.stdout + done.stderr)


def same(printed: Printed, sha256: str) -> None:
    printed.line(f"truth_sha256 is the same: {sha256}$")


def doctored(record: Path, into: Path, change: Callable[[str, bytes], bytes | None]) -> Path:
    """Rewrite a record with messages changed, or omitted where `change` returns None."""
    into.mkdir()
    with RecordReader(record / "run.mcap") as reader, RecordWriter(into / "run.mcap") as writer:
        for m in reader.messages(by_time=False):
            payload = change(m.key, m.payload)
            if payload is not None:
                writer.add(m.key, payload, "", m.t_ns, m.wall_ns)
    return into


@pytest.mark.soak
def test_a_run_of_processes_is_rerun_to_the_same_bits(federation: Federation, pair_sha256: str) -> None:
    """PAIR is flown with every role in its own process.

    Expected: world and agents, flown again in one process, give the same hash, and so does the world alone.
    """
    federation.run(PAIR).ends(with_code=0)
    role = rerun(federation)
    role.line("run again: world, estimator.drone1, estimator.drone2, controller.main")
    same(role, pair_sha256)
    alone = rerun(federation, "--commands-only", of=federation.out / "run.mcap")
    alone.line("agents are not run again: as requested; the world alone, with all recorded commands")
    same(alone, pair_sha256)


@pytest.fixture
def steered(federation: Federation) -> Federation:
    """Return the federation of a run that an operator has steered.

    operator.pilot ── target z_c ── no GPS for drone1 ── acquire drone2 ── velocity ── mode ── release ── bye
    """
    run = federation.run(PAIR, "--rate", "2", "--duration", "3600")
    client = federation.client()
    clock, states = client.subscribe("clock"), client.subscribe("cluster/main/state")
    states.until(lambda m: m["phase"] == "engaged")
    answer = client.request("cluster/main/control", "target", source=PILOT, values={"z_c": 4.0})
    assert answer["ok"], answer
    assert not client.request("cluster/main/control", "target", source=PILOT, values={"nothing": 1.0})["ok"]
    clock.until(lambda m: m["t_ns"] > 7e9)
    ask = {"source": PILOT, "kind": "gps_dropout", "target": "drone1", "for_s": 1.0}
    assert client.request("world/control", "fault_add", **ask)["ok"]
    assert client.request("world/control", "acquire", source=PILOT, drone="drone2", priority=10)["ok"]
    velocity = {"t_ns": 0, "source": PILOT, "velocity_m_s": [0.4, 0.1, 0.0], "yaw_rate_rad_s": 0.3}
    for until_ns in (7.3e9, 7.6e9, 7.9e9):
        client.put("drone/drone2/cmd/velocity", **velocity)
        clock.until(lambda m, until_ns=until_ns: m["t_ns"] > until_ns)
    assert client.request("world/control", "pause", source=PILOT)["ok"]
    events = client.subscribe("world/event")
    client.put("drone/drone2/cmd/mode", t_ns=0, source=PILOT, mode="land")
    events.until(lambda m: m["kind"] == "command")
    assert client.request("world/control", "step", source=PILOT, gates=5)["ok"]
    assert client.request("world/control", "release", source=PILOT, drone="drone2")["ok"]
    assert client.request("world/control", "resume", source=PILOT)["ok"]
    paused_ns = client.get("clock")["clock"]["t_ns"]
    clock.until(lambda m: m["t_ns"] > paused_ns + 2e9)
    assert client.request("world/control", "stop", source=PILOT)["ok"]
    run.ends(with_code=0)
    return federation


def test_a_steered_run_is_rerun_with_the_operator_s_inputs(steered: Federation, pair_sha256: str) -> None:
    """The steered run is rerun from its record, and from copies of it that are cut or changed.

    Expected: the operator's inputs give the same hash; a cut record gives the same truth as far as it goes; without the
    recorded request, the agents answer differently in the same world; another wind gives another world. Lines report
    where the truth first differs: the instant, the drone and by how much.
    """
    sha256 = steered.record().sha256()
    assert sha256 != pair_sha256
    requests = steered.record().all("cluster/main/request")
    assert [(r["op"], r["ok"], r["source"]) for r in requests] == [("target", True, PILOT), ("target", False, PILOT)]
    same(rerun(steered), sha256)
    same(rerun(steered, "--commands-only"), sha256)

    cut = steered.folder / "cut"
    cut.mkdir()
    whole = (steered.out / "run.mcap").read_bytes()
    (cut / "run.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    text = rerun(steered, of=cut)
    found = re.search(r"the record was cut and has no truth_sha256; truth is bit-identical at all (\d+) instants", text)
    assert found
    assert 350 < int(found[1]) <= len(steered.record().all("drone/drone1/truth"))

    unasked = doctored(
        steered.out, steered.folder / "unasked", lambda key, payload: payload if key != REQUEST else None
    )
    role = rerun(steered, of=unasked, code=1)
    role.line(r"truth differs: first drone\d at \d+\.\d+ s by .* m, .* m/s, .* deg, .* deg/s")
    role.line("the world alone, with all recorded commands, gives the recorded truth: the agents answer differently")
    role.line(r"the first answer that differs is (cluster/main/state|drone/drone\d/cmd/velocity) at \d+\.\d+ s")

    other = doctored(steered.out, steered.folder / "other", another_wind)
    role = rerun(steered, of=other, code=1)
    role.line(r"truth differs: first drone1 at 0\.020 s")
    role.line(r"the world alone, with all recorded commands, differs too: first drone1 at 0\.020 s")


REQUEST = "cluster/main/request"


def another_wind(key: str, payload: bytes) -> bytes:
    if key != "world/info":
        return payload
    info = msgpack.unpackb(payload)
    former = info["scenario"]
    info["scenario"] = former.replace("gust_m_s: 0.3", "gust_m_s: 0.31")
    assert info["scenario"] != former
    return msgpack.packb(info) or b""


def test_a_run_with_a_foreign_program_is_rerun_to_the_same_bits(federation: Federation) -> None:
    """One drone is flown in the lockstep by a page of code on zenoh and msgpack.

    Expected: the program's commands are taken from the record with their stamps; the same hash, also if the program
    left by the contract before 1.1, where its participation ends with the loss of its token.
    """
    record = federation.role("record", "--out", str(federation.out))
    world = federation.world(ONE, "--expect", "recorder", "--expect", "plain.client", "--duration", "12")
    federation.client().info()  # waits until the world is there
    subprocess.run(
        [sys.executable, str(PLAIN), federation.endpoint], check=True, timeout=PATIENCE_S, capture_output=True
    )
    world.ends(with_code=0)
    record.ends(with_code=0)
    role = rerun(federation)
    role.line("agents are not run again: none of zsim's took part")
    same(role, federation.record().sha256())
    assert federation.record().positions("drone1")[-1][2] > 0.5
    assert federation.record().events("leave")[0]["t_ns"] < federation.record().end()["last_ns"]
    same(
        rerun(federation, of=doctored(federation.out, federation.folder / "old", before_1_1)),
        federation.record().sha256(),
    )


def before_1_1(key: str, payload: bytes) -> bytes:
    if not key.endswith("/bye"):
        return payload
    return (
        msgpack.packb({k: v for k, v in msgpack.unpackb(payload).items() if k not in ("run_id", "incarnation")}) or b""
    )


def test_a_run_with_a_killed_estimator_is_rerun_by_the_world_alone(federation: Federation) -> None:
    """An estimator dies in flight and is restarted.

    Expected: a line says that agents are not run again, and why; the world alone gives the same hash.
    """
    run = federation.run(PAIR, "--rate", "4", "--duration", "3600")
    client = federation.client()
    clock, events = client.subscribe("clock"), client.subscribe("world/event")
    clock.until(lambda m: m["t_ns"] > 6e9)
    federation.kill("estimator.drone2")
    restart = events.until(lambda m: m["kind"] in ("restart", "superseded"))
    clock.until(lambda m: m["t_ns"] > restart.message["t_ns"] + 3e9)
    assert client.request("world/control", "stop")["ok"]
    run.ends(with_code=0)
    role = rerun(federation)
    role.line(r"agents are not run again: death of estimator.drone2 at \d+\.\d+ s; the world alone")
    same(role, federation.record().sha256())


@pytest.mark.soak
def test_a_realtime_run_is_rerun_by_the_world_alone(federation: Federation) -> None:
    """PAIR is flown in realtime at four times its pace, where commands arrive at any instant.

    Expected: the world alone, with the commands at their recorded instants, gives the same hash.
    """
    federation.run(PAIR, "--realtime", "--rate", "4").ends(with_code=0)
    role = rerun(federation)
    role.line("agents are not run again: in realtime, the times of their answers do not follow from the scenario")
    same(role, federation.record().sha256())


def test_a_missing_or_late_record_is_refused(federation: Federation) -> None:
    """A folder contains no record, and a record begins in flight.

    Expected: one line each, and the exit code for a user's error.
    """
    rerun(federation, code=2, of=federation.folder).line("contains no run.mcap; give the folder of a run")
    federation.run(PAIR, "--in-process", "--duration", "2").ends(with_code=0)
    late = doctored(federation.out, federation.folder / "late", from_the_second_second())
    rerun(federation, code=2, of=late).line("the record has nothing of 0.00 s; a run is flown again from its start")


def damaged(record: Path, into: Path, part: float, cut: int = 0) -> Path:
    """Rewrite a record in many chunks, flip a bit in one, and cut `cut` bytes off the end.

    Args:
        part: share of the chunks that precede the damaged one, 0 to 1.
    """
    into.mkdir()
    path = into / "run.mcap"
    with RecordReader(record / "run.mcap") as reader, RecordWriter(path) as writer:
        for count, m in enumerate(reader.messages(by_time=False), start=1):
            writer.add(m.key, m.payload, "", m.t_ns, m.wall_ns)
            if count % 300 == 0:
                writer.flush()
    data = bytearray(path.read_bytes())
    chunks = [place for place in record_spans(bytes(data)) if place.opcode == Opcode.CHUNK]
    data[chunks[round(part * (len(chunks) - 1))].end - 9] ^= 4
    path.write_bytes(data[: len(data) - cut])
    return into


@pytest.mark.soak
def test_a_damaged_record_is_reported_as_damaged(federation: Federation) -> None:
    """A bit is flipped in the last chunk of a record, in that of a record that is also cut, and in a middle chunk.

    Expected: no line calls the record cut; the truth is the same as far as it can be compared, but the rerun fails.
    """
    federation.run(PAIR, "--in-process", "--duration", "2").ends(with_code=0)
    alike = r"; truth is bit-identical at all (\d+) instants before"
    for name, part, cut, text in (
        ("last", 1.0, 0, "the record is damaged and has no truth_sha256"),
        ("last and cut", 1.0, 9, "the record is damaged and has no truth_sha256"),
        ("middle", 0.5, 0, r"the record has nothing of \d+\.\d+ s, as it is damaged"),
    ):
        printed = rerun(federation, code=1, of=damaged(federation.out, federation.folder / name, part, cut))
        match = re.search(text + alike, printed)
        assert match, printed
        assert 20 < int(match[1]) < 101
        assert "was cut" not in printed
        assert "the world alone" not in printed


def from_the_second_second() -> Callable[[str, bytes], bytes | None]:
    def change(key: str, payload: bytes) -> bytes | None:
        early = key != "world/info" and msgpack.unpackb(payload)["t_ns"] < 1e9
        return None if early else payload

    return change
