"""The parts of the gateway that know neither sockets nor Zenoh."""

import asyncio
import json
import sys
from contextlib import suppress
from typing import Any, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsim.contract import messages
from zsim.contract.framing import GateMessages, key_table
from zsim.contract.messages import ClusterInfo, DroneInfo, Imu, Info, Origin, Status, Velocity
from zsim.errors import DecodeError, NoWorldError
from zsim.transport.session import Heard
from zsim_bridges.gateway import last_values as values_module
from zsim_bridges.gateway.client_limits import Bucket, Turnstile
from zsim_bridges.gateway.echo_filter import Echoes
from zsim_bridges.gateway.http.http_errors import TooManyError
from zsim_bridges.gateway.http.json_tree import methods
from zsim_bridges.gateway.http.openapi import description
from zsim_bridges.gateway.http.zenoh_rest import described
from zsim_bridges.gateway.key_policy import is_control, is_others
from zsim_bridges.gateway.last_values import Values
from zsim_bridges.gateway.lines import stream_requests
from zsim_bridges.gateway.lines.outbox import Outbox
from zsim_bridges.gateway.lines.stream_client import Client
from zsim_bridges.gateway.lockstep_agent import Seat, closing
from zsim_bridges.gateway.message_defaults import Stamps
from zsim_bridges.gateway.transcoding import plain, to_json, to_payload, value_line

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
    text = to_json(VELOCITY, sent)
    assert json.loads(text)["frame"] == "heading"
    assert to_payload(VELOCITY, json.loads(text)) == sent


@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(0, 2**63 - 1))
def test_numbers_survive_both_ways(number: float, t_ns: int):
    sent = messages.encode(Velocity(t_ns, 0, "pilot", (number, 0.0, 0.0), 0.0))
    assert to_payload(VELOCITY, json.loads(to_json(VELOCITY, sent))) == sent


def test_whole_numbers_may_come_as_doubles_but_not_as_fractions():
    value = {"t_ns": 2e7, "seq": 0.0, "source": "m", "velocity_m_s": [0, 1, 2], "yaw_rate_rad_s": 0}
    assert messages.decode(VELOCITY, to_payload(VELOCITY, value)).t_ns == 20_000_000
    with pytest.raises(DecodeError, match=r"t_ns is 0.5; must be a whole number"):
        to_payload(VELOCITY, {**value, "t_ns": 0.5})
    with pytest.raises(DecodeError, match="t_ns is 1e"):
        to_payload(VELOCITY, {**value, "t_ns": 1e30})


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
    assert json.loads(to_json("my/key", payload)) == text


def test_results_that_json_cannot_say_are_base64():
    assert plain({"a": 1}) == {"a": 1}
    assert isinstance(plain(msgspec.msgpack.Ext(1, b"x")), str)


def test_a_deleted_key_has_the_value_null():
    line = value_line(Heard("DELETE", "my/key", b"", "zenoh/bytes", None))
    assert json.loads(line) == {"op": "value", "key": "my/key", "value": None}


# What is filled in


def test_time_number_and_source_are_filled_in_where_they_are_left_out():
    stamps = Stamps("client.a")
    first = stamps.filled(VELOCITY, {"velocity_m_s": [0, 0, 0]}, 40)
    assert first == {"t_ns": 40, "seq": 0, "source": "client.a", "velocity_m_s": [0, 0, 0]}
    assert stamps.filled(VELOCITY, {"seq": 7, "source": "b"}, 40) == {"t_ns": 40, "seq": 7, "source": "b"}
    assert stamps.filled(VELOCITY, {"seq": 2**63 - 1}, 40)["seq"] == 2**63 - 1
    assert stamps.filled(VELOCITY, {}, 60)["seq"] == 1  # one's own count goes on
    assert stamps.filled("drone/drone1/cmd/mode", {}, 60)["seq"] == 0
    assert stamps.filled("my/key", {}, 60) == {}
    assert stamps.filled(VELOCITY, [1], 60) == [1]


def test_what_is_refused_takes_no_number():
    stamps = Stamps("a")
    with suppress(ZeroDivisionError), stamps.all_or_none():
        stamps.filled(VELOCITY, {}, 1 // 0 if stamps.filled(VELOCITY, {}, 0) else 0)
    assert stamps.filled(VELOCITY, {}, 0)["seq"] == 0


# Last values


def test_last_values_are_the_newest_of_what_passed():
    drones = ("drone1", "drone2")
    values, table = Values(drones), key_table(drones)
    said = [
        ("drone/drone1/sensor/imu", messages.encode(Imu(20, 1, 20, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))),
        ("drone/drone1/sensor/status", messages.encode(Status(20, 1, "landed", 99.0, False, None, 2))),
    ]
    values.add("drone/drone1/sensor/imu", b"old")
    values.add_passed("clock", b"now")
    values.add_gate(GateMessages.of(20, 1, table, said))
    assert values.of("drone/drone1/sensor/*") == said
    assert values.of("zsim/drone/*/sensor/imu", "zsim/") == said[:1]
    assert values.of("other/clock", "zsim/") == []
    assert values.of("drone/drone2/**") == []
    assert [key for key, _ in values.of("**")] == ["clock", *(key for key, _ in said)]


def test_values_of_ones_own_have_a_bound_in_bytes(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(values_module, "OWN_BYTES_MAX", 10)
    values = Values(("drone1",))
    values.add("a", b"12345678")
    values.add("b", b"12", "text/plain")
    values.add("c", b"1")
    assert [key for key, _ in values.of("*")] == ["a", "b"]
    values.add("b", b"123")  # does not fit any more: no value is better than an old one
    assert (values.of("b"), values.encoding("b")) == ([], "application/msgpack")
    values.drop("a")
    values.add("c", b"1234567890")
    assert [key for key, _ in values.of("*")] == ["c"]


def test_an_echo_does_not_undo_what_was_said_since():
    def heard(payload: bytes) -> list[bytes]:
        values.add_passed("my/own", payload)
        return [said for _, said in values.of("my/own")]

    values = Values(("drone1",))
    values.say("my/own", b"1", "text/plain")
    values.say("my/own", b"2", "text/plain")
    assert (heard(b"1"), values.encoding("my/own")) == ([b"2"], "text/plain")
    assert heard(b"other") == [b"other"]  # it came to the world before ours
    assert heard(b"2") == [b"2"]
    values.say("my/own", b"3")
    values.drop("my/own")
    assert heard(b"3") == []
    assert heard(b"3") == [b"3"]  # somebody else's
    values.drop("my/own")
    assert heard(b"3") == [b"3"]


def test_an_echo_that_never_came_is_forgotten_with_the_next():
    values = Values(("drone1",))
    for payload in (b"lost", b"1"):
        values.say("my/own", payload)
    values.add_passed("my/own", b"1")
    values.add_passed("my/own", b"lost")
    assert values.of("my/own") == [("my/own", b"lost")]


def test_echoes_that_are_waited_for_have_a_bound():
    echoes = Echoes(keys_max=1)
    for i in range(1000):
        echoes.said("my/own", b"%d" % i)
    assert not echoes.is_old("my/own", b"0")
    assert echoes.is_old("my/own", b"998")
    assert not echoes.is_old("my/own", b"999")


def test_echoes_of_more_keys_than_may_be_are_taken_as_news():
    echoes = Echoes(keys_max=1)
    for key in ("a", "b"):
        for payload in (b"1", b"2"):
            echoes.said(key, payload)
    assert echoes.is_old("a", b"1")
    assert not echoes.is_old("b", b"1")


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
    assert methods(key) == allowed
    assert is_control(key) == (allowed == ("POST",))
    assert is_others(key) == ("PUT" not in allowed)


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
        stream_requests.read(line)


@given(st.binary(max_size=200))
def test_no_bytes_are_more_than_refused(line: bytes):
    with suppress(DecodeError):
        stream_requests.read(line)


# Limits


def test_a_bucket_lets_a_burst_through_and_then_its_rate():
    now = [0.0]
    bucket = Bucket(10.0, 3.0, lambda: now[0])
    for _ in range(3):
        bucket.take()
    with pytest.raises(TooManyError, match=r"more than 10 requests a second; wait 0.100 s"):
        bucket.take()
    now[0] = 0.1
    bucket.take()


def test_a_turnstile_lets_so_many_in():
    turnstile = Turnstile(1, "clients")
    turnstile.enter()
    with pytest.raises(TooManyError, match="there are 1 clients already"):
        turnstile.enter()
    turnstile.leave()
    turnstile.enter()


class House:
    """Of one client, without a run."""

    def __init__(self) -> None:
        self.reported: list[str] = []

    def flight(self) -> Any:
        raise NoWorldError("there is no run now")

    name = "gateway.main"

    def report(self, text: str) -> None:
        self.reported.append(text)


def test_a_client_that_floods_is_slowed_down_and_told():
    async def flood() -> list[bytes]:
        outbox = Outbox(pytest.fail, lambda lost: b"")
        client = Client(House(), outbox, "client.a", True, Bucket(1.0, 3.0, lambda: 0.0))  # type: ignore[arg-type]
        for _ in range(4):
            await client.take(b'{"op": "hello"}')
        return await outbox.take()

    said = [json.loads(line) for line in asyncio.run(flood())]
    assert [message["op"] for message in said] == ["hello"] * 3 + ["error"]
    assert said[-1]["error"] == "more than 1 requests a second; wait 1.000 s"


def test_a_fault_of_ours_is_an_answer_and_a_line_for_a_person():
    async def ask(house: House) -> list[bytes]:
        outbox = Outbox(pytest.fail, lambda lost: b"")
        client = Client(house, outbox, "client.a", True, Bucket(1.0, 3.0, lambda: 0.0))  # type: ignore[arg-type]
        await client.take(b'{"op": "subscribe", "key": "a"}')  # this house has no feed
        return await outbox.take()

    house = House()
    (line,) = asyncio.run(ask(house))
    assert json.loads(line)["error"].startswith("the gateway failed (AttributeError)")
    assert house.reported[0].startswith("client.a: b")


def test_a_full_outbox_loses_the_oldest_values_and_says_so():
    async def fill() -> list[bytes]:
        outbox = Outbox(pytest.fail, lambda lost: b"lost %d\n" % lost, bytes_max=10)
        for number in range(5):
            outbox.put(b"abc%d" % number, may_go=True)
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


# Seats


SERVED = (("estimator.drone1", "drone1"), ("estimator.drone2", "drone2"), ("matlab.main", "main"))


def seat(**given: Any) -> Seat:
    handed: list[tuple[int, list[Any]]] = []
    values = {
        "name": "matlab.main",
        "info": info(),
        "period_ns": GATE_NS,
        "reads": ["drone/*/estimate"],
        "gates": (),
        "now_ns": lambda: 0,
        "served": SERVED,
    }
    made = Seat(**{**values, **given}, hand_over=lambda t_ns, inputs: handed.append((t_ns, inputs)))
    made.handed = handed  # type: ignore[attr-defined]
    return made


def test_what_closes_the_gates_of_a_seat_comes_at_every_gate_and_is_not_its_own():
    estimates = ("drone/drone1/estimate", "drone/drone2/estimate")
    assert closing(info(), ["drone/*/estimate"], "matlab.main", SERVED) == estimates
    assert (
        closing(info(), ["drone/*/estimate"], "mine.drone1", {("mine.drone1", "drone1"), *SERVED[1:]}) == estimates[1:]
    )
    assert closing(info(), ["cluster/*/state", "view/drones"], "matlab.main", SERVED) == ("clock",)
    assert closing(info(), ["cluster/*/state"], "eye.one", SERVED) == ("cluster/main/state",)
    assert closing(info(), [], "eye.one", SERVED) == ("clock",)
    truths = ("drone/drone1/truth", "drone/drone2/truth")
    statuses = ("drone/drone1/sensor/status", "drone/drone2/sensor/status")
    assert set(closing(info(), ["**"], "eye.one", ())) == {*truths, *statuses}  # nobody estimates: nothing to wait for


def test_a_seat_reads_what_closes_its_gates_and_counts_the_sensors_that_it_takes():
    made = seat(reads=["drone/drone1/sensor/*"], gates=["clock"])
    assert (made.reads, made.counted) == (("drone/drone1/sensor/*", "clock"), ("drone1",))


def test_a_step_hands_over_what_came_and_returns_the_answer():
    made = seat()
    made.receive("drone/drone1/estimate", "e")
    made.answer(["out"])  # type: ignore[list-item]
    assert made.step(40) == ["out"]
    assert made.handed == [(40, [("drone/drone1/estimate", "e")])]  # type: ignore[attr-defined]
    made.leave()
    assert made.step(60) == []


def test_in_realtime_a_late_gate_goes_with_a_newer_one():
    now = [10 * GATE_NS]
    made = seat(info=info("realtime"), now_ns=lambda: now[0])
    made.receive("a", 1)
    assert made.step(8 * GATE_NS) == []
    made.receive("b", 2)
    made.answer([])
    made.step(9 * GATE_NS)
    assert made.handed == [(9 * GATE_NS, [("a", 1), ("b", 2)])]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"name": "nodot"}, "must be a role, a dot and a name"),
        ({"name": "A.b"}, "must be a role, a dot and a name"),
        ({"period_ns": GATE_NS + 1}, "must be a multiple of 0.02"),
        ({"period_ns": 0}, "must be a multiple of 0.02"),
        ({"gates": ["drone/*/truth"]}, "has a wildcard"),
    ],
)
def test_what_is_no_seat_is_refused(given: dict[str, Any], said: str):
    with pytest.raises(DecodeError, match=said):
        seat(**given)


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
    said = described(Heard("PUT", "zsim/a", payload, encoding, None))
    assert said == {"key": "zsim/a", "value": value, "encoding": encoding, "timestamp": None}


def test_a_refusal_of_zenohs_has_the_key_error():
    assert described(Heard("ERROR", "", b"no", "zenoh/string", None))["key"] == "ERROR"


def test_the_description_has_every_message_and_where_clients_speak():
    paths = description()["paths"]
    for shape in messages.types_by_shape():
        kind, _, rest = shape.partition("/*")
        path = f"/json/{kind}/{{{kind.rsplit('/')[-1]}}}{rest}" if "*" in shape else f"/json/{shape}"
        key = shape.replace("*", "x1")
        assert ("put" in paths[path]) == ("PUT" in methods(key)), path
    assert "post" in paths["/json/world/control"]
    json.dumps(description())


def test_lists_in_each_other_without_end_are_refused():
    nested: Any = 1
    for _ in range(5000):
        nested = [nested]
    with pytest.raises(DecodeError):
        to_payload(VELOCITY, {"velocity_m_s": nested})


def test_no_schema_asks_for_what_is_filled_in():
    sent = description()["components"]["schemas"]["VelocitySent"]
    assert sent["required"] == ["velocity_m_s", "yaw_rate_rad_s"]
    velocity = sent["properties"]["velocity_m_s"]
    assert (velocity["minItems"], velocity["maxItems"], velocity["items"]["maximum"]) == (3, 3, sys.float_info.max)
