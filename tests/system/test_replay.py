"""Replays of records: the recorded bytes, pictures included, on the keys of the flight."""

import re
import shutil
import signal
import urllib.request
from collections import defaultdict
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh
from federation import ONE, PAIR, PAIR_ROLES, Federation, Role
from picture_pump import calibration, pumping
from refused import parts
from wire import PATIENCE_S, Client

from zsim.record import RecordReader

GATE_NS = 20_000_000
RESAID = ("drone/*/sensor/*", "drone/*/truth", "drone/*/estimate", "drone/*/cmd/*", "cluster/*/state")


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Path:
    """The folder of a run of PAIR, which lasts 12 s."""
    with Federation(tmp_path_factory.mktemp("flown")) as federation:
        federation.run(PAIR, "--in-process").ends(with_code=0)
        return federation.out


def replay(federation: Federation, folder: Path, *options: str) -> Role:
    role = federation.start("replay", str(folder), "--listen", federation.endpoint, *options)
    role.line("replay of run [0-9a-f]+ as 'zsim' on tcp/")
    return role


class Ear:
    """Collects the raw payloads of some keys, each before the client receives anything that arrives later."""

    def __init__(self, client: Client, *expressions: str) -> None:
        self.received: defaultdict[str, list[bytes]] = defaultdict(list)
        take = zenoh.handlers.Callback(self._take, indirect=False)
        self._kept = [client.session.declare_subscriber(f"zsim/{each}", take) for each in expressions]

    def _take(self, sample: zenoh.Sample) -> None:
        self.received[str(sample.key_expr).removeprefix("zsim/")].append(sample.payload.to_bytes())


def recorded(folder: Path, *expressions: str) -> dict[str, list[bytes]]:
    output: defaultdict[str, list[bytes]] = defaultdict(list)
    with RecordReader(folder / "run.mcap") as reader:
        wanted = [key for key in reader.topics() if any(matches(each, key) for each in expressions)]
        for m in reader.messages(wanted):
            output[m.key].append(m.payload)
    return dict(output)


def matches(expression: str, key: str) -> bool:
    return zenoh.KeyExpr(expression).includes(zenoh.KeyExpr(key))


def resume(client: Client) -> None:
    assert client.request("world/control", "resume")["ok"]


def without_source(payload: bytes) -> dict[str, Any]:
    """Return an estimate without its source, since the recorded run was a single process."""
    return unsigned(msgpack.unpackb(payload))


def unsigned(message: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in message.items() if name != "source"}


def test_a_replay_publishes_the_recorded_payloads(federation: Federation, flown: Path) -> None:
    """Sensors, truth, estimates, commands and states are replayed as fast as possible.

        run.mcap ──▶ zsim replay ──▶ sensors, truth, estimates, commands, states ──▶ a client

    Expected: the recorded payloads, byte for byte; a new run_id and the id of the recorded run; views, although none
    are recorded; a clock that ends as stopped.
    """
    role = replay(federation, flown, "--rate", "0", "--paused")
    client = federation.client()
    ear, clock, views = Ear(client, *RESAID), client.subscribe("clock"), client.subscribe("view/**")
    info = client.info()
    original = msgpack.unpackb(recorded(flown, "world/info")["world/info"][0])
    assert info["replay_of"] == original["run_id"] != info["run_id"]
    assert info["scenario"] == original["scenario"]
    clock.until(lambda m: m["state"] == "paused")
    first = recorded(flown, *RESAID)
    resume(client)
    clock.until(lambda m: m["state"] == "stopped")
    role.ends(with_code=0)
    assert re.search("^ended: .*record", role.text(), re.MULTILINE)
    for key, payloads in first.items():
        rest = [payload for payload in payloads if msgpack.unpackb(payload)["t_ns"] > 0]
        output = [payload for payload in ear.received[key] if msgpack.unpackb(payload)["t_ns"] > 0]
        assert output == rest, key
    assert {view.key for view in views.now()} >= {"view/drones", "view/cluster/main"}


def test_the_console_of_a_replay_has_a_timeline(federation: Federation, flown: Path) -> None:
    """The replay pauses at its end and lasts until it is interrupted."""
    pytest.importorskip("viser", reason="viser is not installed; pip install '.[console]'")
    role = replay(federation, flown, "--console", "--rate", "0")
    client = federation.client()
    clock = client.subscribe("clock")
    address = role.line("steer at").text.rpartition(" ")[2]
    client.request("world/control", "seek", t_s=0)
    clock.until(lambda m: m["state"] == "paused")
    timeline = client.request("world/control", "timeline")["result"]
    assert timeline["to_s"] > timeline["from_s"]
    assert {mark["kind"] for mark in timeline["marks"]} >= {"mode"}
    assert client.request("world/control", "seek", t_s=timeline["to_s"] / 2)["ok"]
    with urllib.request.urlopen(f"{address}state", timeout=PATIENCE_S) as answer:
        assert answer.status == 200
    role.signal(signal.SIGINT)
    role.ends(with_code=0)
    federation.nobody_left()


def test_a_part_of_a_record_can_be_replayed(federation: Federation, flown: Path) -> None:
    """The GPS and the truth alone are replayed from 5 s to 6 s at rate 4.

    Expected: exactly these messages; available last values; no faster pace than requested.
    """
    keys = ("drone/*/truth", "drone/*/sensor/gps")
    options = [part for key in keys for part in ("--keys", key)]
    role = replay(federation, flown, "--from", "5", "--to", "6", "--rate", "4", "--paused", *options)
    client = federation.client()
    ear, clock = Ear(client, "drone/**", "cluster/**"), client.subscribe("clock")
    stood = clock.until(lambda m: m["state"] == "paused")
    assert stood.message["t_ns"] == 5_000_000_000
    role.line("/ 6 s")  # progress refers to the part played, not to the scenario's duration
    assert client.get("drone/drone1/truth")["drone/drone1/truth"]["t_ns"] == 5_000_000_000
    resume(client)
    over = clock.until(lambda m: m["state"] == "stopped")
    role.ends(with_code=0)
    assert re.search("^ended: .*6 s", role.text(), re.MULTILINE)
    assert over.wall_s - stood.wall_s > 0.24  # 1 s at rate 4, less the gate at which the replay was paused
    assert {key.split("/", 2)[2] for key in ear.received} == {"truth", "sensor/gps"}
    wanted = recorded(flown, *keys)
    for key, payloads in ear.received.items():
        in_time = [p for p in wanted[key] if 5_000_000_000 < msgpack.unpackb(p)["t_ns"] <= 6_000_000_000]
        assert [p for p in payloads if msgpack.unpackb(p)["t_ns"] > 5_000_000_000] == in_time


def test_echo_prints_replayed_payloads(federation: Federation, flown: Path) -> None:
    """`zsim echo` on a replay prints recorded payloads."""
    replay(federation, flown, "--rate", "0.2")
    echo = federation.role("echo", "drone/drone2/sensor/imu", "--raw", "-n", "20")
    echo.ends(with_code=0)
    on_record = {payload.hex() for payload in recorded(flown, "drone/drone2/sensor/imu")["drone/drone2/sensor/imu"]}
    output = [line.text.split('"message": "')[1].rstrip('"}') for line in echo.lines if '"message"' in line.text]
    assert len(output) == 20
    assert set(output) <= on_record


def test_an_estimator_reproduces_its_estimates_from_a_record(federation: Federation, flown: Path) -> None:
    """The estimator of drone1 runs on the record in lockstep, next to a recorder.

        run.mcap ──▶ zsim replay ──sensors──▶ estimator.drone1 ──estimate──▶ recorder

    Expected: its estimates equal those recorded in flight to the bit, and only they are published; those of drone2 are
    replayed; the new record is marked as one of a replay, and rerun refuses it.
    """
    role = replay(federation, flown, "--rate", "0", "--expect", "estimator.drone1", "--expect", "recorder")
    others = [federation.role("estimator", "drone1"), federation.role("record", "--out", str(federation.out))]
    for each in (role, *others):
        each.ends(with_code=0)
    mine, yours = recorded(federation.out, "drone/*/estimate"), recorded(flown, "drone/*/estimate")
    assert len(mine["drone/drone1/estimate"]) == 601
    assert [*map(without_source, mine["drone/drone1/estimate"])] == [
        *map(without_source, yours["drone/drone1/estimate"])
    ]
    assert {msgpack.unpackb(payload)["source"] for payload in mine["drone/drone1/estimate"]} == {"estimator.drone1"}
    assert mine["drone/drone2/estimate"] == yours["drone/drone2/estimate"]
    again = federation.start("rerun", str(federation.out))
    again.ends(with_code=2)
    again.line("is the record of a replay; rerun that of run")


@pytest.mark.soak
def test_an_estimator_does_not_wait_for_keys_left_out(federation: Federation, flown: Path) -> None:
    """`--keys` withholds the GPS from the estimator under test.

    Expected: nobody waits for what is left out; the estimator counts no GPS and as many other samples as in flight.
    """
    kinds = [part for kind in ("imu", "mag", "baro", "flow", "status") for part in ("--keys", f"drone/*/sensor/{kind}")]
    role = replay(federation, flown, "--rate", "0", "--expect", "estimator.drone1", "--to", "4", *kinds)
    client = federation.client()
    estimates = client.subscribe("drone/drone1/estimate")
    federation.role("estimator", "drone1").ends(with_code=0)
    role.ends(with_code=0)
    last = estimates.until(lambda m: m["t_ns"] == 4_000_000_000).message
    assert last["sensors"]["gps"] == [0, 0]
    flew = next(
        m
        for m in map(msgpack.unpackb, recorded(flown, "drone/drone1/estimate")["drone/drone1/estimate"])
        if m["t_ns"] == 4_000_000_000
    )
    assert sum(last["sensors"]["baro"]) == sum(flew["sensors"]["baro"]) > 0


def test_a_replay_allows_time_control_and_refuses_flight(federation: Federation, flown: Path) -> None:
    """Requests that control time succeed; those that control flight are refused.

    Expected: pause, step, seek, rate, resume and stop work; each refusal of a flight request gives the reason.
    """
    role = replay(federation, flown, "--rate", "2")
    client = federation.client()
    clock, events = client.subscribe("clock"), client.subscribe("world/event")
    clock.until(lambda m: m["t_ns"] > 0)
    assert client.request("world/control", "pause")["ok"]
    stood_ns = clock.until(lambda m: m["state"] == "paused").message["t_ns"]
    assert client.request("world/control", "step", gates=3)["ok"]
    assert clock.until(lambda m: m["t_ns"] > stood_ns + 2 * GATE_NS).message["t_ns"] == stood_ns + 3 * GATE_NS
    assert client.request("world/control", "seek", t_s=8)["ok"]
    assert client.request("world/control", "step")["ok"]
    clock.until(lambda m: m["t_ns"] == 8_000_000_000)
    assert client.get("drone/drone1/truth")["drone/drone1/truth"]["t_ns"] == 8_000_000_000
    for t_s in (99, "noon"):
        assert parts(client.request("world/control", "seek", t_s=t_s)["error"]) == ("t_s", repr(t_s))
    for key, op, args in (
        ("world/control", "acquire", {"drone": "drone1", "priority": 10}),
        ("world/control", "fault_add", {"kind": "gps_dropout", "target": "drone1"}),
        ("cluster/main/control", "takeoff", {}),
    ):
        assert "replay" in client.request(key, op, **args)["error"]
    client.put("drone/drone1/cmd/mode", t_ns=0, source="tester.one", mode="land")
    refused = events.until(lambda m: m["kind"] == "refused" and m["source"] == "tester.one").message
    assert "replay" in refused["data"]["reason"]
    assert client.request("world/control", "seek", t_s=2)["ok"]
    assert client.request("world/control", "rate", value=3)["ok"]
    resume(client)
    clock.until(lambda m: 2_000_000_000 < m["t_ns"] < 3_000_000_000)
    assert client.request("world/control", "stop", reason="seen enough")["ok"]
    assert events.until(lambda m: m["kind"] == "end").message["data"]["replay_of"]
    role.ends(with_code=0)


def test_a_recorder_may_join_a_replay_late(federation: Federation, flown: Path) -> None:
    """A recorder joins a replay from 2 s once 6 s of it have been played and its beginning is no longer kept.

    Expected: the record names the original run; its end gives the duration that was played.
    """
    role = replay(federation, flown, "--from", "2", "--to", "9", "--rate", "0", "--paused")
    client = federation.client()
    clock, events = client.subscribe("clock"), client.subscribe("world/event")
    clock.until(lambda m: m["state"] == "paused")
    assert client.request("world/control", "step", gates=300)["ok"]
    clock.until(lambda m: m["t_ns"] == 8_000_000_000)
    recorder = federation.role("record", "--out", str(federation.out))
    events.until(lambda m: m["kind"] == "join" and m["subject"] == "recorder")
    resume(client)
    for each in (role, recorder):
        each.ends(with_code=0)
    on_record = recorded(federation.out, "world/*", "drone/drone1/truth")
    (info,) = map(msgpack.unpackb, on_record["world/info"])
    assert info["replay_of"]
    stamps = [msgpack.unpackb(payload)["t_ns"] for payload in on_record["drone/drone1/truth"]]
    assert 2_900_000_000 < stamps[0] < 3_100_000_000  # only the last 5 s are kept
    assert stamps[-1] == 9_000_000_000
    end = next(m for m in map(msgpack.unpackb, on_record["world/event"]) if m["kind"] == "end")
    assert end["data"]["sim_s"] == 7.0


@pytest.mark.soak
def test_all_roles_reproduce_their_outputs_from_a_record(federation: Federation, flown: Path) -> None:
    """Both estimators and the controller take part as in a flight.

    Expected: they publish what they did in flight, and their recorded messages are not replayed as well.
    """
    expect = [part for name in PAIR_ROLES for part in ("--expect", name)]
    role = replay(federation, flown, "--rate", "0", "--to", "6", *expect)
    client = federation.client()
    answers = ("cluster/main/state", "drone/drone1/estimate", "drone/drone2/estimate")
    watches = {key: client.subscribe(key) for key in answers}
    split = [name.split(".") for name in PAIR_ROLES]
    others = [federation.role(role_, thing) for role_, thing in split]
    for each in (role, *others):
        each.ends(with_code=0)
    for key, watch in watches.items():
        watch.until(lambda m: m["t_ns"] == 6_000_000_000)
        output = [unsigned(received.message) for received in watch.received]
        assert output == [*map(without_source, recorded(flown, key)[key][:301])]


@pytest.mark.soak
def test_a_truncated_record_is_played_as_far_as_it_goes(federation: Federation, flown: Path) -> None:
    """The writer of the record died.

    Expected: the record is played as far as it goes; a folder without a record, a time after its end and a bad key are
    reported.
    """
    cut = federation.folder / "cut"
    cut.mkdir()
    whole = (flown / "run.mcap").read_bytes()
    (cut / "run.mcap").write_bytes(whole[: len(whole) // 2])
    role = replay(federation, cut, "--rate", "0")
    role.ends(with_code=0)
    assert re.search("^ended: .*record", role.text(), re.MULTILINE)
    for folder, options, text in (
        (federation.folder, [], "contains no run.mcap"),
        (flown, ["--from", "100"], "contains no gate from 100 s on; nothing can be played"),
        (flown, ["--keys", "a//b"], "key is 'a//b'"),
    ):
        refused = federation.start("replay", str(folder), "--listen", federation.endpoint, *options)
        refused.ends(with_code=2)
        refused.line(text)
    shutil.rmtree(cut)


FRONT, FRONT_INFO = "drone/drone1/camera/front", "drone/drone1/camera/front/info"


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Path:
    """The folder of a run of 4 s with an external camera."""
    with Federation(tmp_path_factory.mktemp("filmed")) as federation:
        world = federation.world(ONE.replace("duration_s: 10", "duration_s: 4"), "--rate", "1", "--expect", "recorder")
        recorder = federation.role("record", "--out", str(federation.out))
        camera = federation.client()
        camera.subscribe("clock").until(lambda m: m["state"] == "running")
        camera.put(FRONT_INFO, **calibration())
        with pumping(camera, FRONT):
            world.ends(with_code=0)
            recorder.ends(with_code=0)
        assert federation.record().complete
        return federation.out


def test_pictures_are_recorded_and_the_run_can_be_rerun_without_them(filmed: Path, federation: Federation) -> None:
    pictures = recorded(filmed, FRONT)[FRONT]
    assert len(pictures) > 20
    assert len(set(pictures)) == len(pictures)  # no picture is recorded twice
    assert len(recorded(filmed, FRONT_INFO)[FRONT_INFO]) == 1
    again = federation.start("rerun", str(filmed))
    again.ends(with_code=0)
    again.line("truth_sha256 is the same")


def test_a_replay_publishes_the_recorded_pictures_and_calibration(filmed: Path, federation: Federation) -> None:
    pictures = recorded(filmed, FRONT)[FRONT]
    role = replay(federation, filmed, "--rate", "2", "--paused")
    client = federation.client()
    ear, clock = Ear(client, FRONT), client.subscribe("clock")
    clock.until(lambda m: m["state"] == "paused")
    resume(client)
    clock.until(lambda m: m["t_ns"] >= 3_000_000_000)
    (info,) = client.get("drone/*/camera/*/info").values()
    assert {name: info[name] for name in ("K", "D", "orientation_wxyz")} == {
        name: calibration()[name] for name in ("K", "D", "orientation_wxyz")
    }
    assert FRONT not in client.get("drone/*/sensor/status")
    clock.until(lambda m: m["state"] == "stopped")
    role.ends(with_code=0)
    played = ear.received[FRONT]
    assert len(played) > 1  # a busy machine skips some
    assert [payload for payload in pictures if payload in set(played)] == played
