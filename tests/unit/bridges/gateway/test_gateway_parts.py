"""The parts of the gateway that use neither sockets nor Zenoh."""

import asyncio
import json
import re
import sys
from collections.abc import Callable
from contextlib import nullcontext, suppress
from types import SimpleNamespace
from typing import Any, Literal

import msgspec
import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request
from hypothesis import given
from hypothesis import strategies as st
from refused import has_terms, refused
from synthetic_pictures import NO_JPEG, image, jpeg

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Status, Velocity
from zsim.contract.framing import GateMessages, key_table
from zsim.contract.messages import ClusterInfo, DroneInfo, Imu, Info, Origin
from zsim.errors import DecodeError, NoWorldError, SessionError
from zsim.runtime.rate_limit import RateLimit
from zsim.transport.session import RawSample
from zsim_bridges.gateway import client_streams, run_access
from zsim_bridges.gateway.client_messages import (
    ClientLimit,
    JoinRequest,
    MessageDefaults,
    TooManyError,
    count_request,
    decode_request,
    is_control_key,
    is_reserved,
    is_valid,
    json_to_payload,
    json_value,
    payload_to_json,
    value_line,
)
from zsim_bridges.gateway.client_streams import BOUNDARY, Outbox, PictureFeed, PictureFeeds, picture_part
from zsim_bridges.gateway.gateway_server import Client
from zsim_bridges.gateway.http_server import AccessCheck, description, methods_of, sample_to_json, value_event
from zsim_bridges.gateway.run_access import EchoFilter, LastValues, LockstepSession, SharedSubscriptions, gate_keys_of

VELOCITY = "drone/drone1/cmd/velocity"
GATE_NS = 20_000_000


def info(mode: Literal["lockstep", "realtime"] = "lockstep") -> Info:
    drones = ("drone1", "drone2")
    return Info(
        t_ns=0, seq=0, contract=1, run_id="run", federation="zsim", mode=mode, rate=0.0, gate_ns=GATE_NS,
        physics_dt_ns=2_500_000, command_delay_ns=GATE_NS, seed=1, origin=Origin(0.0, 0.0, 0.0),
        drones=tuple(DroneInfo(name, "ardrone2") for name in drones), clusters=(ClusterInfo("main", drones),),
        scenario="", scenario_sha256="", version="", fingerprint="",
    )  # fmt: skip


# Values as JSON and back


@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(0, 2**63 - 1))
def test_json_has_every_field_and_converts_back_to_the_same_bytes(number: float, t_ns: int):
    sent = messages.encode(Velocity(t_ns, 3, "pilot", (number, -0.0, 1e-300), 0.1))
    value = json.loads(payload_to_json(VELOCITY, sent))
    assert value["frame"] == "heading"
    assert json_to_payload(VELOCITY, value) == sent


def test_integers_may_be_sent_as_doubles_but_not_as_fractions():
    value = {"t_ns": 2e7, "seq": 0.0, "source": "m", "velocity_m_s": [0, 1, 2], "yaw_rate_rad_s": 0}
    assert messages.decode(VELOCITY, json_to_payload(VELOCITY, value)).t_ns == 20_000_000
    for t_ns, term in ((0.5, "0.5"), (1e30, "1e…")):
        with refused(DecodeError, "t_ns", term):
            json_to_payload(VELOCITY, {**value, "t_ns": t_ns})


def test_deeply_nested_lists_are_refused():
    nested: Any = 1
    for _ in range(5000):
        nested = [nested]
    with pytest.raises(DecodeError):
        json_to_payload(VELOCITY, {"velocity_m_s": nested})


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (msgspec.msgpack.encode({"a": b"\x00\x01"}), {"a": "AAE="}),
        (msgspec.msgpack.encode([1, "x", None]), [1, "x", None]),
        (b"\xc1 no msgpack", "wSBubyBtc2dwYWNr"),
        (b"\xca\x7f\x80\x00\x00", None),  # infinity, which JSON cannot represent
    ],
)
def test_payloads_of_unknown_keys_are_shown_as_far_as_json_allows(payload: bytes, text: Any):
    assert json.loads(payload_to_json("my/key", payload)) == text


@pytest.mark.parametrize("payload", [b"\xc0", msgspec.msgpack.encode({"t_ns": 1}), b"\xc1 no msgpack", b""])
def test_a_payload_that_is_not_a_message_of_its_key_is_not_shown(payload: bytes):
    assert not is_valid(VELOCITY, payload)
    with pytest.raises(DecodeError):
        payload_to_json(VELOCITY, payload)
    sent = RawSample("PUT", VELOCITY, payload or b"\xc0", "zenoh/bytes", None)
    assert (value_line(sent), value_event(sent)) == (b"", b"")
    assert is_valid("my/key", payload)


def test_values_unknown_to_json_become_base64_and_a_deleted_key_null():
    assert json_value({"a": 1}) == {"a": 1}
    assert isinstance(json_value(msgspec.msgpack.Ext(1, b"x")), str)
    line = value_line(RawSample("DELETE", "my/key", b"", "zenoh/bytes", None))
    assert json.loads(line) == {"op": "value", "key": "my/key", "value": None}


def test_missing_time_sequence_number_and_source_are_filled_in():
    defaults = MessageDefaults("client.a")
    first = defaults.fill(VELOCITY, {"velocity_m_s": [0, 0, 0]}, 40)
    assert first == {"t_ns": 40, "seq": 0, "source": "client.a", "velocity_m_s": [0, 0, 0]}
    assert defaults.fill(VELOCITY, {"seq": 7, "source": "b"}, 40) == {"t_ns": 40, "seq": 7, "source": "b"}
    assert defaults.fill(VELOCITY, {"seq": 2**63 - 1}, 40)["seq"] == 2**63 - 1
    with suppress(ZeroDivisionError), defaults.transaction():  # a refused message uses no number
        defaults.fill(VELOCITY, {}, 1 // 0 if defaults.fill(VELOCITY, {}, 0) else 0)
    assert defaults.fill(VELOCITY, {}, 60)["seq"] == 1  # the sender's own count continues
    assert defaults.fill("drone/drone1/cmd/mode", {}, 60)["seq"] == 0
    assert defaults.fill("my/key", {}, 60) == {}
    assert defaults.fill(VELOCITY, [1], 60) == [1]


# Last values


def test_last_values_are_the_newest_of_each_key():
    table = key_table(("drone1", "drone2"))
    values = LastValues(table)
    entries = [
        ("drone/drone1/sensor/imu", messages.encode(Imu(20, 1, 20, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))),
        ("drone/drone1/sensor/status", messages.encode(Status(20, 1, "landed", 99.0, False, None, 2))),
    ]
    values.add("drone/drone1/sensor/imu", b"old")
    values.add_forwarded("clock", b"now")
    values.add_gate(GateMessages.of(20, 1, table, entries))
    assert values.matching("drone/drone1/sensor/*") == entries
    assert values.matching("zsim/drone/*/sensor/imu", "zsim/") == entries[:1]
    assert values.matching("other/clock", "zsim/") == []
    assert values.matching("drone/drone2/**") == []
    assert [key for key, _ in values.matching("**")] == ["clock", *(key for key, _ in entries)]


@pytest.fixture
def values() -> LastValues:
    return LastValues(key_table(("drone1",)))


def test_own_values_are_bounded_in_bytes(monkeypatch: pytest.MonkeyPatch, values: LastValues):
    monkeypatch.setattr(run_access, "OWN_BYTES_MAX", 10)
    values.add("a", b"12345678")
    values.add_own("b", b"12", "text/plain")
    values.add("c", b"1")
    assert [key for key, _ in values.matching("*")] == ["a", "b"]
    values.add("b", b"123")  # no longer fits: no value is better than an old one
    assert (values.matching("b"), values.encoding("b")) == ([], "application/msgpack")
    values.drop("a")
    values.add("c", b"1234567890")
    assert [key for key, _ in values.matching("*")] == ["c"]


def test_an_echo_does_not_overwrite_a_later_value(values: LastValues):
    def echoed(payload: bytes) -> list[bytes]:
        values.add_forwarded("my/own", payload)
        return [entries for _, entries in values.matching("my/own")]

    values.add_own("my/own", b"1", "text/plain")
    values.add_own("my/own", b"2", "text/plain")
    assert (echoed(b"1"), values.encoding("my/own")) == ([b"2"], "text/plain")
    assert echoed(b"other") == [b"other"]  # another sender's, which reached the world before ours
    assert echoed(b"2") == [b"2"]
    values.add_own("my/own", b"3")
    values.drop("my/own")
    assert echoed(b"3") == []
    assert echoed(b"3") == [b"3"]  # another sender's
    values.drop("my/own")
    assert echoed(b"3") == [b"3"]
    for payload in (b"lost", b"1"):
        values.add_own("my/own", payload)
    assert [echoed(b"1"), echoed(b"lost")][1] == [b"lost"]  # the next echo discards one that never came


def test_expected_echoes_are_bounded():
    echoes = EchoFilter(keys_max=1)
    for i in range(1000):
        echoes.add("a", b"%d" % i)
    assert [echoes.is_stale("a", each) for each in (b"0", b"998", b"999")] == [False, True, False]
    for key in ("a", "b"):  # echoes beyond the limit of keys count as new values
        for payload in (b"1", b"2"):
            echoes.add(key, payload)
    assert [echoes.is_stale(key, b"1") for key in ("a", "b")] == [True, False]


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
def test_clients_may_write_only_keys_that_no_role_owns(key: str, allowed: tuple[str, ...]):
    assert methods_of(key) == allowed
    assert is_control_key(key) == (allowed == ("POST",))
    assert is_reserved(key) == ("PUT" not in allowed)


# Requests and limits


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
def test_an_invalid_request_is_refused(line: bytes):
    with pytest.raises(DecodeError, match="request: "):
        decode_request(line)


@given(st.binary(max_size=200))
def test_any_bytes_are_decoded_or_refused(line: bytes):
    with suppress(DecodeError):
        decode_request(line)


def test_a_rate_limit_admits_a_burst_and_then_its_rate():
    now = [0.0]
    limit = RateLimit(0.1, 3.0, lambda: now[0])
    for _ in range(3):
        count_request(limit)
    with pytest.raises(TooManyError, match=r"0\.100 s"):
        count_request(limit)
    now[0] = 0.1
    count_request(limit)


def test_a_client_limit_admits_only_its_number_of_clients():
    limit = ClientLimit(1)
    limit.enter()
    with pytest.raises(TooManyError):
        limit.enter()
    limit.leave()
    limit.enter()


def test_a_refused_subscription_leaves_nothing_to_share():
    """A later client would share a subscription on which nothing arrives."""
    loop: Any = None
    link: Any = Unreadable()
    subscriptions = SharedSubscriptions(loop, ClientLimit(1))
    subscriptions.attach(link)
    for _ in range(2):
        with refused(SessionError, VELOCITY):
            subscriptions.subscribe(VELOCITY, lambda sample: None)


class Unreadable:
    """A session whose certificate does not permit reading."""

    def declare_subscriber(self, expression: str, callback: Callable[[RawSample], None]) -> Callable[[], None]:
        raise SessionError(f"{expression}: may not be read")


class FakeGateway:
    """A gateway with one client and without a run."""

    name = "gateway.main"

    def __init__(self) -> None:
        self.reported: list[str] = []
        self.report = self.reported.append

    def run(self) -> Any:
        raise NoWorldError("there is no run now")

    def answers(self, *lines: bytes) -> list[Any]:
        async def ask() -> list[bytes]:
            outbox = Outbox(pytest.fail, lambda lost: b"")
            client = Client(self, outbox, "client.a", True, RateLimit(1.0, 3.0, lambda: 0.0))  # type: ignore[arg-type]
            for line in lines:
                await client.handle_line(line)
            return await outbox.take()

        return [json.loads(line) for line in asyncio.run(ask())]


def test_a_flooding_client_is_limited_and_told_when_to_try_again():
    entries = FakeGateway().answers(*[b'{"op": "hello"}'] * 4)
    assert [message["op"] for message in entries] == ["hello"] * 3 + ["error"]
    assert "1.000 s" in entries[-1]["error"]


def test_a_client_needs_a_valid_name_other_than_that_of_the_gateway():
    for name, own in {"myctrl": "client.myctrl", "matlab.main": "matlab.main"}.items():
        assert FakeGateway().answers(b'{"op": "hello", "name": "%b"}' % name.encode())[0]["name"] == own
    for op in (b'"hello"', b'"join", "period_s": 0.02'):
        for name in ("A.b", ".", "gateway.main"):
            (answer,) = FakeGateway().answers(b'{"op": %b, "name": "%b"}' % (op, name.encode()))
            assert has_terms(answer["error"], "name", f"'{name}'"), answer


def test_an_internal_error_is_answered_and_reported():
    gateway = FakeGateway()
    (answer,) = gateway.answers(b'{"op": "subscribe", "key": "a"}')  # this gateway has no feed
    assert "AttributeError" in answer["error"]
    assert "client.a" in gateway.reported[0]


@pytest.mark.parametrize(("droppable", "left", "cuts"), [(True, [b"lost 3\n", b"abc3", b"abc4"], 0), (False, None, 1)])
def test_a_full_outbox_drops_the_oldest_values_but_no_answers(droppable: bool, left: list[bytes] | None, cuts: int):
    cut: list[str] = []

    async def fill() -> list[bytes]:
        outbox = Outbox(lambda: cut.append("cut"), lambda lost: b"lost %d\n" % lost, bytes_max=10)
        for number in range(5):
            outbox.put(b"abc%d" % number, droppable)
        return await outbox.take()

    lines = asyncio.run(fill())
    assert len(cut) == cuts
    assert left in (None, lines)


# Lockstep


REQUIRED = (("estimator.drone1", "drone1"), ("estimator.drone2", "drone2"), ("matlab.main", "main"))
ESTIMATES = ("drone/drone1/estimate", "drone/drone2/estimate")


class LockstepLines(LockstepSession):
    """A session in a run whose event loop calls at once; it records the lines that it sends."""

    def __init__(
        self,
        name: str = "matlab.main",
        mode: Literal["lockstep", "realtime"] = "lockstep",
        period_s: float = 0.02,
        **request: Any,
    ) -> None:
        self.lines: list[Any] = []
        self.now_ns = 0
        join = JoinRequest(name=name, period_s=period_s, **{"reads": ["drone/*/estimate"], **request})
        run: Any = SimpleNamespace(info=info(mode), required_processes=REQUIRED, check_known=lambda key: None)
        loop: Any = SimpleNamespace(call_soon_threadsafe=lambda act, *args: act(*args))
        super().__init__(name, join, run, loop, lambda line: self.lines.append(json.loads(line)))

    def reply(self, outputs: list[Any]) -> None:
        self._answers.put(outputs)


@pytest.mark.parametrize(
    ("reads", "name", "required", "gates"),
    [
        (["drone/*/estimate"], "matlab.main", REQUIRED, ESTIMATES),
        (["drone/*/estimate"], "mine.drone1", {("mine.drone1", "drone1"), *REQUIRED[1:]}, ESTIMATES[1:]),
        (["cluster/*/state", "view/drones"], "matlab.main", REQUIRED, ("clock",)),
        (["cluster/*/state"], "eye.one", REQUIRED, ("cluster/main/state",)),
        ([], "eye.one", REQUIRED, ("clock",)),
        (["**"], "eye.one", (), (*(f"drone/drone{k}/{what}" for k in (1, 2) for what in ("sensor/status", "truth")),)),
    ],
)
def test_the_gate_keys_of_a_session_come_from_others_at_every_gate(
    reads: list[str], name: str, required: Any, gates: tuple[str, ...]
):
    assert sorted(gate_keys_of(info(), reads, name, required)) == sorted(gates)


def test_an_agent_reads_its_gate_keys_and_counts_its_sensors():
    session = LockstepLines(reads=["drone/drone1/sensor/*"], gates=["clock"])
    assert (session.reads, session.counted) == (("drone/drone1/sensor/*", "clock"), ("drone1",))


def test_a_step_passes_the_inputs_and_returns_the_answer():
    session = LockstepLines()
    session.receive("drone/drone1/estimate", "e")
    session.reply(["out"])
    assert session.step(40) == ["out"]
    assert session.lines == [{"op": "gate", "t_ns": 40, "inputs": [{"key": "drone/drone1/estimate", "value": "e"}]}]
    session.leave()
    assert session.step(60) == []


def test_in_realtime_a_late_gate_is_merged_into_the_next():
    session = LockstepLines(mode="realtime")
    session.run.now_ns = 10 * GATE_NS  # type: ignore[misc]
    session.receive("a", 1)
    assert session.step(8 * GATE_NS) == []
    session.receive("b", 2)
    session.reply([])
    session.step(9 * GATE_NS)
    inputs = [{"key": "a", "value": 1}, {"key": "b", "value": 2}]
    assert session.lines == [{"op": "gate", "t_ns": 9 * GATE_NS, "inputs": inputs}]


@pytest.mark.parametrize(
    ("given", "terms"),
    [
        ({"period_s": 0.020000001}, ("period_s", "0.02…")),
        ({"period_s": 0.0}, ("period_s", "0…")),
        ({"gates": ["drone/*/truth"]}, ("gates…",)),
    ],
)
def test_an_invalid_join_is_refused_with_its_field(given: dict[str, Any], terms: tuple[str, ...]):
    with refused(DecodeError, *terms):
        LockstepLines(**given)


# HTTP


@pytest.mark.parametrize(
    ("connected", "fault", "raised"),
    [
        (False, RuntimeError("Connection closed."), ConnectionResetError),  # the body was cut off: nothing to report
        (True, RuntimeError("a fault"), None),
        (False, KeyError("a fault"), None),
        (False, ValueError("x"), None),
    ],
)
def test_an_internal_error_is_reported_unless_the_client_has_left(
    connected: bool, fault: Exception, raised: Any
) -> None:
    reported: list[str] = []
    request = make_mocked_request("PUT", "/json/mine", headers={"Host": "localhost"})
    if not connected:
        request.protocol.transport = None  # type: ignore[misc]

    async def fail(_: web.Request) -> web.StreamResponse:
        raise fault

    with pytest.raises(raised) if raised else nullcontext():
        asyncio.run(AccessCheck(None, reported.append).check(request, fail))
    assert [("PUT /json/mine" in line, repr(fault) in line) for line in reported] == ([] if raised else [(True, True)])


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
def test_values_are_described_as_the_rest_plugin_of_zenoh_does(encoding: str, payload: bytes, value: Any):
    entries = sample_to_json(RawSample("PUT", "zsim/a", payload, encoding, None))
    assert entries == {"key": "zsim/a", "value": value, "encoding": encoding, "timestamp": None}
    assert sample_to_json(RawSample("ERROR", "", b"no", encoding, None))["key"] == "ERROR"


def test_the_description_has_every_message_and_the_writable_keys():
    paths = description()["paths"]
    for shape in messages.types_by_shape():
        kind, _, rest = shape.partition("/*")
        path = f"/json/{kind}/{{{kind.rsplit('/')[-1]}}}{rest}" if "*" in shape else f"/json/{shape}"
        key = shape.replace("*", "x1")
        assert ("put" in paths[path]) == ("PUT" in methods_of(key)), path
    assert "post" in paths["/json/world/control"]
    json.dumps(description())
    sent = description()["components"]["schemas"]["VelocitySent"]
    assert sent["required"] == ["velocity_m_s", "yaw_rate_rad_s"]  # without the fields that the gateway fills in
    velocity = sent["properties"]["velocity_m_s"]
    assert (velocity["minItems"], velocity["maxItems"], velocity["items"]["maximum"]) == (3, 3, sys.float_info.max)


FRONT = keys.camera("d1", "front")
MS = 1_000_000


def sample(number: int, data: bytes | None = None) -> RawSample:
    return RawSample("PUT", FRONT, messages.encode(image(number * 20 * MS, number, data)), "", None)


class Publisher:
    """Counts subscriptions and publishes to the current subscribers."""

    def __init__(self) -> None:
        self.subscribers: list[Callable[[RawSample], None]] = []
        self.made = 0

    def subscribe(self, key: str, subscriber: Callable[[RawSample], None]) -> Callable[[], None]:
        assert key == FRONT
        self.made += 1
        self.subscribers.append(subscriber)
        return lambda: self.subscribers.remove(subscriber)

    def publish(self, published: RawSample) -> None:
        for subscriber in self.subscribers:
            subscriber(published)


def test_a_late_viewer_gets_the_newest_picture_and_none_twice() -> None:
    async def look() -> list[int | None]:
        feed = PictureFeed(FRONT, lambda reason: None)
        for number in range(5):
            feed.receive(sample(number))
        late = await feed.wait_after(-1, 1.0)
        assert late is not None
        again = await feed.wait_after(late.number, 0.0)
        feed.receive(sample(9))
        next_one = await feed.wait_after(late.number, 1.0)
        return [picture and picture.image.seq for picture in (late, again, next_one)]

    assert asyncio.run(look()) == [4, None, 9]


def test_a_waiting_viewer_gets_the_next_picture() -> None:
    async def look() -> int:
        feed = PictureFeed(FRONT, lambda reason: None)
        waiting = asyncio.create_task(feed.wait_after(-1, 60.0))
        await asyncio.sleep(0)
        feed.receive(sample(7))
        picture = await waiting
        assert picture is not None
        return picture.image.seq

    assert asyncio.run(look()) == 7


@pytest.mark.parametrize("payload", [b"\xc1", messages.encode(image(0, 0, NO_JPEG)), b""])
def test_an_invalid_picture_is_refused_and_not_shown(payload: bytes) -> None:
    refused: list[str] = []

    async def look() -> PictureFeed:
        feed = PictureFeed(FRONT, refused.append)
        feed.receive(sample(3))
        feed.receive(RawSample("PUT", FRONT, payload, "", None))
        return feed

    newest = asyncio.run(look()).newest
    assert newest is not None
    assert newest.image.seq == 3
    assert len(refused) == 1
    assert refused[0].startswith(FRONT)


def test_all_viewers_share_one_subscription_which_ends_with_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_streams, "LINGER_S", 0.0)
    publisher = Publisher()

    async def look() -> list[int]:
        feeds = PictureFeeds(publisher.subscribe, lambda reason: None)
        counts = []

        async def watch() -> None:
            with feeds.watched(FRONT) as feed:
                assert await feed.wait_after(-1, 60.0)

        watchers = [asyncio.create_task(watch()) for _ in range(100)]
        await asyncio.sleep(0)
        counts.append(publisher.made)
        publisher.publish(sample(0))
        await asyncio.gather(*watchers)
        closed = asyncio.Event()
        asyncio.get_running_loop().call_later(0.0, closed.set)  # runs after the calls that the watchers scheduled
        await closed.wait()
        return [*counts, len(publisher.subscribers)]

    assert asyncio.run(look()) == [1, 0]


def test_pictures_of_an_earlier_run_are_dropped() -> None:
    async def look() -> bool:
        publisher = Publisher()
        feeds = PictureFeeds(publisher.subscribe, lambda reason: None)
        with feeds.watched(FRONT) as feed:
            publisher.publish(sample(0))
            assert feed.newest
            feeds.clear_pictures()
            return feed.newest is None

    assert asyncio.run(look())


def test_a_part_has_its_headers_and_ends_with_the_boundary() -> None:
    head, _, rest = picture_part(image(20 * MS)).partition(b"\r\n\r\n")
    assert rest == jpeg() + f"\r\n--{BOUNDARY}\r\n".encode()
    assert b"Content-Length: %d" % len(jpeg()) in head
    assert b"X-Timestamp: 0.016000" in head


def test_every_path_of_the_openapi_description_declares_its_parameters() -> None:
    for path, item in description()["paths"].items():
        assert re.findall(r"\{(\w+)\}", path) == [each["name"] for each in item["parameters"]]
