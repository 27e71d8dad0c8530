"""The parts of the gateway that know neither sockets nor Zenoh."""

import asyncio
import json
import sys
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refused import refused

from zsim.contract import messages
from zsim.contract.flight_messages import Status, Velocity
from zsim.contract.framing import GateMessages, key_table
from zsim.contract.messages import ClusterInfo, DroneInfo, Imu, Info, Origin
from zsim.errors import DecodeError, NoWorldError
from zsim.runtime.rate_limit import RateLimit
from zsim.transport.session import RawSample
from zsim_bridges.gateway import publications, stream_requests
from zsim_bridges.gateway.access_check import ConnectionLimit, count_request
from zsim_bridges.gateway.client_messages import (
    MessageDefaults,
    TooManyError,
    is_control_key,
    is_reserved,
    is_sound,
    json_to_payload,
    json_value,
    payload_to_json,
    value_line,
)
from zsim_bridges.gateway.client_streams import Outbox
from zsim_bridges.gateway.http_routes import description
from zsim_bridges.gateway.http_trees import described_sample, methods_of, value_event
from zsim_bridges.gateway.lockstep_session import LockstepSession, gate_keys_of
from zsim_bridges.gateway.publications import EchoFilter, LastValues
from zsim_bridges.gateway.stream_client import Client

VELOCITY = "drone/drone1/cmd/velocity"
GATE_NS = 20_000_000


def info(mode: Literal["lockstep", "realtime"] = "lockstep", drones: tuple[str, ...] = ("drone1", "drone2")) -> Info:
    return Info(
        t_ns=0, seq=0, contract=1, run_id="run", federation="zsim", mode=mode, rate=0.0, gate_ns=GATE_NS,
        physics_dt_ns=2_500_000, command_delay_ns=GATE_NS, seed=1, origin=Origin(0.0, 0.0, 0.0),
        drones=tuple(DroneInfo(name, "ardrone2") for name in drones), clusters=(ClusterInfo("main", drones),),
        scenario="", scenario_sha256="", version="", fingerprint="",
    )  # fmt: skip


# Values as JSON and back


def test_json_has_every_field_and_comes_back_to_the_same_bytes():
    sent = messages.encode(Velocity(20_000_000, 3, "pilot", (1.0, -0.0, 1e-300), 0.1))
    text = payload_to_json(VELOCITY, sent)
    assert json.loads(text)["frame"] == "heading"
    assert json_to_payload(VELOCITY, json.loads(text)) == sent


@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(0, 2**63 - 1))
def test_numbers_survive_both_ways(number: float, t_ns: int):
    sent = messages.encode(Velocity(t_ns, 0, "pilot", (number, 0.0, 0.0), 0.0))
    assert json_to_payload(VELOCITY, json.loads(payload_to_json(VELOCITY, sent))) == sent


def test_whole_numbers_may_come_as_doubles_but_not_as_fractions():
    value = {"t_ns": 2e7, "seq": 0.0, "source": "m", "velocity_m_s": [0, 1, 2], "yaw_rate_rad_s": 0}
    assert messages.decode(VELOCITY, json_to_payload(VELOCITY, value)).t_ns == 20_000_000
    with pytest.raises(DecodeError, match=r"t_ns is 0\.5"):
        json_to_payload(VELOCITY, {**value, "t_ns": 0.5})
    with refused(DecodeError, "t_ns", "1e…"):
        json_to_payload(VELOCITY, {**value, "t_ns": 1e30})


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (msgspec.msgpack.encode({"a": b"\x00\x01"}), {"a": "AAE="}),
        (msgspec.msgpack.encode([1, "x", None]), [1, "x", None]),
        (b"\xc1 no msgpack", "wSBubyBtc2dwYWNr"),
        (b"\xca\x7f\x80\x00\x00", None),  # infinity, which JSON cannot say
    ],
)
def test_what_the_contract_does_not_know_is_shown_as_well_as_json_can(payload: bytes, text: Any):
    assert json.loads(payload_to_json("my/key", payload)) == text


@pytest.mark.parametrize("payload", [b"\xc0", msgspec.msgpack.encode({"t_ns": 1}), b"\xc1 no msgpack", b""])
def test_what_is_no_message_of_its_key_is_not_shown(payload: bytes):
    assert not is_sound(VELOCITY, payload)
    with pytest.raises(DecodeError):
        payload_to_json(VELOCITY, payload)
    sent = RawSample("PUT", VELOCITY, payload or b"\xc0", "zenoh/bytes", None)
    assert (value_line(sent), value_event(sent)) == (b"", b"")
    assert is_sound("my/key", payload)


def test_results_that_json_cannot_say_are_base64():
    assert json_value({"a": 1}) == {"a": 1}
    assert isinstance(json_value(msgspec.msgpack.Ext(1, b"x")), str)


def test_a_deleted_key_has_the_value_null():
    line = value_line(RawSample("DELETE", "my/key", b"", "zenoh/bytes", None))
    assert json.loads(line) == {"op": "value", "key": "my/key", "value": None}


# What is filled in


def test_time_number_and_source_are_filled_in_where_they_are_left_out():
    defaults = MessageDefaults("client.a")
    first = defaults.fill(VELOCITY, {"velocity_m_s": [0, 0, 0]}, 40)
    assert first == {"t_ns": 40, "seq": 0, "source": "client.a", "velocity_m_s": [0, 0, 0]}
    assert defaults.fill(VELOCITY, {"seq": 7, "source": "b"}, 40) == {"t_ns": 40, "seq": 7, "source": "b"}
    assert defaults.fill(VELOCITY, {"seq": 2**63 - 1}, 40)["seq"] == 2**63 - 1
    assert defaults.fill(VELOCITY, {}, 60)["seq"] == 1  # one's own count goes on
    assert defaults.fill("drone/drone1/cmd/mode", {}, 60)["seq"] == 0
    assert defaults.fill("my/key", {}, 60) == {}
    assert defaults.fill(VELOCITY, [1], 60) == [1]


def test_what_is_refused_takes_no_number():
    defaults = MessageDefaults("a")
    with suppress(ZeroDivisionError), defaults.transaction():
        defaults.fill(VELOCITY, {}, 1 // 0 if defaults.fill(VELOCITY, {}, 0) else 0)
    assert defaults.fill(VELOCITY, {}, 0)["seq"] == 0


# Last values


def test_last_values_are_the_newest_of_what_passed():
    drones = ("drone1", "drone2")
    values, table = LastValues(key_table(drones)), key_table(drones)
    entries = [
        ("drone/drone1/sensor/imu", messages.encode(Imu(20, 1, 20, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))),
        ("drone/drone1/sensor/status", messages.encode(Status(20, 1, "landed", 99.0, False, None, 2))),
    ]
    values.add("drone/drone1/sensor/imu", b"old")
    values.add_passed("clock", b"now")
    values.add_gate(GateMessages.of(20, 1, table, entries))
    assert values.matching("drone/drone1/sensor/*") == entries
    assert values.matching("zsim/drone/*/sensor/imu", "zsim/") == entries[:1]
    assert values.matching("other/clock", "zsim/") == []
    assert values.matching("drone/drone2/**") == []
    assert [key for key, _ in values.matching("**")] == ["clock", *(key for key, _ in entries)]


def test_values_of_ones_own_have_a_bound_in_bytes(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(publications, "OWN_BYTES_MAX", 10)
    values = LastValues(key_table(("drone1",)))
    values.add("a", b"12345678")
    values.add("b", b"12", "text/plain")
    values.add("c", b"1")
    assert [key for key, _ in values.matching("*")] == ["a", "b"]
    values.add("b", b"123")  # does not fit any more: no value is better than an old one
    assert (values.matching("b"), values.encoding("b")) == ([], "application/msgpack")
    values.drop("a")
    values.add("c", b"1234567890")
    assert [key for key, _ in values.matching("*")] == ["c"]


def test_an_echo_does_not_undo_what_was_said_since():
    def echoed(payload: bytes) -> list[bytes]:
        values.add_passed("my/own", payload)
        return [entries for _, entries in values.matching("my/own")]

    values = LastValues(key_table(("drone1",)))
    values.add_own("my/own", b"1", "text/plain")
    values.add_own("my/own", b"2", "text/plain")
    assert (echoed(b"1"), values.encoding("my/own")) == ([b"2"], "text/plain")
    assert echoed(b"other") == [b"other"]  # it came to the world before ours
    assert echoed(b"2") == [b"2"]
    values.add_own("my/own", b"3")
    values.drop("my/own")
    assert echoed(b"3") == []
    assert echoed(b"3") == [b"3"]  # somebody else's
    values.drop("my/own")
    assert echoed(b"3") == [b"3"]


def test_an_echo_that_never_came_is_forgotten_with_the_next():
    values = LastValues(key_table(("drone1",)))
    for payload in (b"lost", b"1"):
        values.add_own("my/own", payload)
    values.add_passed("my/own", b"1")
    values.add_passed("my/own", b"lost")
    assert values.matching("my/own") == [("my/own", b"lost")]


def test_echoes_that_are_waited_for_have_a_bound():
    echoes = EchoFilter(keys_max=1)
    for i in range(1000):
        echoes.add("my/own", b"%d" % i)
    assert not echoes.is_stale("my/own", b"0")
    assert echoes.is_stale("my/own", b"998")
    assert not echoes.is_stale("my/own", b"999")


def test_echoes_of_more_keys_than_may_be_are_taken_as_news():
    echoes = EchoFilter(keys_max=1)
    for key in ("a", "b"):
        for payload in (b"1", b"2"):
            echoes.add(key, payload)
    assert echoes.is_stale("a", b"1")
    assert not echoes.is_stale("b", b"1")


# Who may say what


@pytest.mark.parametrize(
    ("key", "allowed"),
    [
        ("world/control", ("POST",)),
        ("cluster/main/control", ("POST",)),
        ("world/info", ("GET",)),
        ("clock", ("GET",)),
        ("drone/drone1/truth", ("GET",)),
        ("drone/drone1/sensor/lidar", ("GET",)),
        ("process/world/bye", ("GET",)),
        ("@gate", ("GET",)),
        ("a/@b", ("GET",)),
        (VELOCITY, ("GET", "PUT")),
        ("drone/drone1/estimate", ("GET", "PUT")),
        ("my/key", ("GET", "PUT", "POST")),
    ],
)
def test_clients_speak_where_nobody_else_does(key: str, allowed: tuple[str, ...]):
    assert methods_of(key) == allowed
    assert is_control_key(key) == (allowed == ("POST",))
    assert is_reserved(key) == ("PUT" not in allowed)


# Requests


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"[]",
        b'{"op": 1}',
        b'{"op": "ask", "key": "k", "request": "r", "timeout_s": 1e9}',
        b'{"op": "join", "name": "a", "period_s": -1}',
        b'{"op": "hello", "id": 1.5}',
        b"\xff",
        b"[" * 100_000,
    ],
)
def test_what_is_no_request_is_refused(line: bytes):
    with pytest.raises(DecodeError, match="request: "):
        stream_requests.decode_request(line)


@given(st.binary(max_size=200))
def test_no_bytes_are_more_than_refused(line: bytes):
    with suppress(DecodeError):
        stream_requests.decode_request(line)


# Limits


def test_a_bucket_lets_a_burst_through_and_then_its_rate():
    now = [0.0]
    limit = RateLimit(0.1, 3.0, lambda: now[0])
    for _ in range(3):
        count_request(limit)
    with pytest.raises(TooManyError, match=r"0\.100 s"):
        count_request(limit)
    now[0] = 0.1
    count_request(limit)


def test_a_limit_lets_so_many_in():
    limit = ConnectionLimit(1, "clients")
    limit.enter()
    with pytest.raises(TooManyError):
        limit.enter()
    limit.leave()
    limit.enter()


class FakeGateway:
    """Of one client, without a run."""

    def __init__(self) -> None:
        self.reported: list[str] = []

    def run(self) -> Any:
        raise NoWorldError("there is no run now")

    name = "gateway.main"

    def report(self, text: str) -> None:
        self.reported.append(text)


def test_a_client_that_floods_is_slowed_down_and_told():
    async def flood() -> list[bytes]:
        outbox = Outbox(pytest.fail, lambda lost: b"")
        client = Client(FakeGateway(), outbox, "client.a", True, RateLimit(1.0, 3.0, lambda: 0.0))  # type: ignore[arg-type]
        for _ in range(4):
            await client.handle_line(b'{"op": "hello"}')
        return await outbox.take()

    entries = [json.loads(line) for line in asyncio.run(flood())]
    assert [message["op"] for message in entries] == ["hello"] * 3 + ["error"]
    assert "1.000 s" in entries[-1]["error"]


def test_a_fault_of_ours_is_an_answer_and_a_line_for_a_person():
    async def ask(gateway: FakeGateway) -> list[bytes]:
        outbox = Outbox(pytest.fail, lambda lost: b"")
        client = Client(gateway, outbox, "client.a", True, RateLimit(1.0, 3.0, lambda: 0.0))  # type: ignore[arg-type]
        await client.handle_line(b'{"op": "subscribe", "key": "a"}')  # this gateway has no feed
        return await outbox.take()

    gateway = FakeGateway()
    (line,) = asyncio.run(ask(gateway))
    assert "AttributeError" in json.loads(line)["error"]
    assert "client.a" in gateway.reported[0]


def test_a_full_outbox_loses_the_oldest_values_and_says_so():
    async def fill() -> list[bytes]:
        outbox = Outbox(pytest.fail, lambda lost: b"lost %d\n" % lost, bytes_max=10)
        for number in range(5):
            outbox.put(b"abc%d" % number, droppable=True)
        return await outbox.take()

    assert asyncio.run(fill()) == [b"lost 3\n", b"abc3", b"abc4"]


def test_a_client_that_does_not_take_its_answers_is_cut_off():
    async def fill() -> list[str]:
        cuts: list[str] = []
        outbox = Outbox(lambda: cuts.append("cut"), lambda lost: b"", bytes_max=10)
        for _ in range(5):
            outbox.put(b"answer")
        return cuts

    assert asyncio.run(fill()) == ["cut"]


# Lockstep


REQUIRED = (("estimator.drone1", "drone1"), ("estimator.drone2", "drone2"), ("matlab.main", "main"))


class LockstepLines(LockstepSession):
    """A session in a run, whose loop is now; it keeps the lines that it sends."""

    def __init__(
        self,
        name: str = "matlab.main",
        mode: Literal["lockstep", "realtime"] = "lockstep",
        period_s: float = 0.02,
        **request: Any,
    ) -> None:
        self.lines: list[Any] = []
        self.now_ns = 0
        join = stream_requests.JoinRequest(name=name, period_s=period_s, **{"reads": ["drone/*/estimate"], **request})
        run: Any = SimpleNamespace(info=info(mode), required_processes=REQUIRED, check_known=lambda key: None)
        loop: Any = SimpleNamespace(call_soon_threadsafe=lambda act, *args: act(*args))
        super().__init__(name, join, run, loop, lambda line: self.lines.append(json.loads(line)))

    def reply(self, outputs: list[Any]) -> None:
        self._answers.put(outputs)


def test_what_closes_the_gates_of_a_session_comes_at_every_gate_and_is_not_its_own():
    estimates = ("drone/drone1/estimate", "drone/drone2/estimate")
    assert gate_keys_of(info(), ["drone/*/estimate"], "matlab.main", REQUIRED) == estimates
    assert (
        gate_keys_of(info(), ["drone/*/estimate"], "mine.drone1", {("mine.drone1", "drone1"), *REQUIRED[1:]})
        == estimates[1:]
    )
    assert gate_keys_of(info(), ["cluster/*/state", "view/drones"], "matlab.main", REQUIRED) == ("clock",)
    assert gate_keys_of(info(), ["cluster/*/state"], "eye.one", REQUIRED) == ("cluster/main/state",)
    assert gate_keys_of(info(), [], "eye.one", REQUIRED) == ("clock",)
    truths = ("drone/drone1/truth", "drone/drone2/truth")
    statuses = ("drone/drone1/sensor/status", "drone/drone2/sensor/status")
    assert set(gate_keys_of(info(), ["**"], "eye.one", ())) == {
        *truths,
        *statuses,
    }  # nobody estimates: nothing to wait for


def test_an_agent_reads_what_closes_its_gates_and_counts_the_sensors_that_it_takes():
    session = LockstepLines(reads=["drone/drone1/sensor/*"], gates=["clock"])
    assert (session.reads, session.counted) == (("drone/drone1/sensor/*", "clock"), ("drone1",))


def test_a_step_hands_over_what_came_and_returns_the_answer():
    session = LockstepLines()
    session.receive("drone/drone1/estimate", "e")
    session.reply(["out"])
    assert session.step(40) == ["out"]
    assert session.lines == [{"op": "gate", "t_ns": 40, "inputs": [{"key": "drone/drone1/estimate", "value": "e"}]}]
    session.leave()
    assert session.step(60) == []


def test_in_realtime_a_late_gate_goes_with_a_newer_one():
    session = LockstepLines(mode="realtime")
    session.run.now_ns = 10 * GATE_NS  # type: ignore[misc]
    session.receive("a", 1)
    assert session.step(8 * GATE_NS) == []
    session.receive("b", 2)
    session.reply([])
    session.step(9 * GATE_NS)
    (line,) = session.lines
    assert (line["t_ns"], [(each["key"], each["value"]) for each in line["inputs"]]) == (
        9 * GATE_NS,
        [("a", 1), ("b", 2)],
    )


@pytest.mark.parametrize(
    ("given", "terms"),
    [
        ({"name": "nodot"}, ("name", "'nodot'")),
        ({"name": "A.b"}, ("name", "'A.b'")),
        ({"period_s": 0.020000001}, ("period_s", "0.02…")),
        ({"period_s": 0.0}, ("period_s", "0…")),
        ({"gates": ["drone/*/truth"]}, ("gates…",)),
    ],
)
def test_an_invalid_join_is_refused_by_its_field(given: dict[str, Any], terms: tuple[str, ...]):
    with refused(DecodeError, *terms):
        LockstepLines(**given)


# HTTP


@pytest.mark.parametrize(
    ("encoding", "payload", "value"),
    [
        ("application/json", b'{"a": [1]}', {"a": [1]}),
        ("text/json", b"1", 1),
        ("text/plain", b"hi", "hi"),
        ("zenoh/string;utf-8", b"hi", "hi"),
        ("application/msgpack;Imu", b"\x80", "gA=="),
        ("application/json", b"{", "ew=="),
        ("text/plain", b"\xff", "/w=="),
        ("text/plain", b"", None),
    ],
)
def test_values_are_described_as_the_plugin_does(encoding: str, payload: bytes, value: Any):
    entries = described_sample(RawSample("PUT", "zsim/a", payload, encoding, None))
    assert entries == {"key": "zsim/a", "value": value, "encoding": encoding, "timestamp": None}


def test_a_refusal_of_zenohs_has_the_key_error():
    assert described_sample(RawSample("ERROR", "", b"no", "zenoh/string", None))["key"] == "ERROR"


def test_the_description_has_every_message_and_where_clients_speak():
    paths = description()["paths"]
    for shape in messages.types_by_shape():
        kind, _, rest = shape.partition("/*")
        path = f"/json/{kind}/{{{kind.rsplit('/')[-1]}}}{rest}" if "*" in shape else f"/json/{shape}"
        key = shape.replace("*", "x1")
        assert ("put" in paths[path]) == ("PUT" in methods_of(key)), path
    assert "post" in paths["/json/world/control"]
    json.dumps(description())


def test_lists_in_each_other_without_end_are_refused():
    nested: Any = 1
    for _ in range(5000):
        nested = [nested]
    with pytest.raises(DecodeError):
        json_to_payload(VELOCITY, {"velocity_m_s": nested})


def test_no_schema_asks_for_what_is_filled_in():
    sent = description()["components"]["schemas"]["VelocitySent"]
    assert sent["required"] == ["velocity_m_s", "yaw_rate_rad_s"]
    velocity = sent["properties"]["velocity_m_s"]
    assert (velocity["minItems"], velocity["maxItems"], velocity["items"]["maximum"]) == (3, 3, sys.float_info.max)
