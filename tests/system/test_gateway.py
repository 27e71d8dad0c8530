"""The gateway as its clients see it: streams, lockstep sessions, both HTTP trees and access control."""

import asyncio
import base64
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from typing import Any

import aiohttp
import msgpack
import pytest
from federation import ONE, Federation
from gateway_process import GatewayProcess, LineConnection
from refused import has_terms, parts
from wire import PATIENCE_S

from zsim_bridges.gateway.gateway_server import UNAUTHENTICATED_MAX
from zsim_bridges.web.web_server import STRANGERS_MAX

GATE_NS = 20_000_000
PILOT = "client.pilot"
FLOWN = ONE.replace("expect: []", f"expect: [{PILOT}]").replace("duration_s: 10", "duration_s: 4")
"""One drone flown by a client in a lockstep session; time waits for the client from the start."""
STANDING = FLOWN.replace("duration_s: 4", "duration_s: 3600")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Federation, GatewayProcess]]:
    """A world of one drone in realtime, and a gateway."""
    with Federation(tmp_path_factory.mktemp("lab")) as federation:
        federation.world(ONE.replace("duration_s: 10", "duration_s: 3600"), "--realtime")
        gateway = GatewayProcess(federation).in_run()
        with gateway.events("/json/drone/drone1/sensor/imu") as events:
            next(events)
        yield federation, gateway


@pytest.fixture
def gateway(lab: tuple[Federation, GatewayProcess]) -> GatewayProcess:
    return lab[1]


@pytest.fixture
def stream(gateway: GatewayProcess) -> Iterator[LineConnection]:
    with gateway.connect() as stream:
        yield stream


# Streams


def test_hello_names_the_client_and_describes_the_run(stream):
    response = stream.request("hello", name="laptop")
    assert (response["name"], response["mode"], response["gate_s"], response["drones"]) == (
        "client.laptop",
        "realtime",
        0.02,
        ["drone1"],
    )


def last_ns(stream) -> int:
    (last,) = stream.request("latest", key="drone/drone1/sensor/imu")["values"]
    return last["value"]["t_ns"]


def test_last_values_come_from_the_cache_and_streams_deliver_each_sample(stream):
    stream.send("subscribe", key="drone/*/sensor/imu")
    first, second = (stream.next("value")["value"] for _ in range(2))
    assert second["seq"] == first["seq"] + 1
    assert first["accel_m_s2"][2] == pytest.approx(9.81, abs=1.0)
    while last_ns(stream) < first["t_ns"]:  # the world sends samples to the cache in batches, which arrive later
        stream.next("value")
    keys = {entry["key"] for entry in stream.request("latest", key="drone/drone1/**")["values"]}
    assert {"drone/drone1/truth", "drone/drone1/sensor/status", "drone/drone1/sensor/imu"} <= keys
    assert stream.request("unsubscribe", key="drone/*/sensor/imu")["op"] == "unsubscribe"


def test_a_client_flies_a_drone_with_puts(gateway):
    with gateway.connect() as stream:
        stream.request("hello", name="flyer")
        stream.send("subscribe", key="drone/drone1/sensor/status")
        assert stream.request("put", key="drone/drone1/cmd/mode", value={"mode": "takeoff"})["op"] == "put"
        _until(stream, "state", {"hovering", "flying"})
        up = {"velocity_m_s": [0, 0, 0.2], "yaw_rate_rad_s": 0}

        def fly_up() -> None:  # repeated with each status, as a late command is refused in realtime
            stream.send("put", key="drone/drone1/cmd/velocity", value=up, quiet=True)

        _until(stream, "commander", {"client.flyer"}, fly_up)
    with gateway.connect() as other:
        other.request("hello", name="other")
        other.send("subscribe", key="drone/drone1/sensor/status")
        _until(other, "commander", {None})  # the first client has disconnected, so nobody commands the drone
        assert other.request("put", key="drone/drone1/cmd/mode", value={"mode": "land"})["op"] == "put"
        _until(other, "state", {"landed"})


def _until(stream: LineConnection, field: str, wanted: set[Any], act: Callable[[], None] = lambda: None) -> None:
    """Call `act` now and after each received value until the value of `field` is among `wanted`."""
    until_s = time.monotonic() + PATIENCE_S
    act()
    while stream.next("value")["value"].get(field) not in wanted:
        assert time.monotonic() < until_s, (field, wanted)
        act()


def test_the_world_and_controllers_answer_requests(stream):
    assert parts(stream.request("ask", key="world/control", request="nope")["error"]) == ("op", "'nope'")
    answer = stream.request("ask", key="world/control", request="acquire", args={"drone": "drone1", "priority": 0})
    assert answer["ok"], answer
    assert stream.request("ask", key="world/control", request="release", args={"drone": "drone1"})["ok"]
    error = stream.request("ask", key="cluster/main/control", request="hold")["error"]
    assert parts(error) == ("cluster", "'main'")


# each request and the terms that its refusal must contain
REFUSED: dict[bytes, tuple[str, ...]] = {
    b'{"op": "nope"}': ("'nope'", "$.op"),
    b'{"op": "put", "key": "drone/drone1/cmd/mode", "value": {"mode": "up"}}': ("mode is 'up'", "takeoff"),
    b'{"op": "put", "key": "drone/drone1/cmd/velocity", "value": {"velocity_m_s": [1, 0], "yaw_rate_rad_s": 0}}': (
        "velocity_m_s is [1, 0]",
    ),
    b'{"op": "put", "key": "drone/ghost/cmd/mode", "value": {"mode": "land"}}': ("drone is 'ghost'", "drone1"),
    b'{"op": "put", "key": "drone/drone1/sensor/imu", "value": {}}': ("drone/drone1/sensor/imu: ", "drone/…/cmd/…"),
    b'{"op": "put", "key": "process/world/bye", "value": {"reason": "x"}}': ("process/world/bye: ", "drone/…/cmd/…"),
    b'{"op": "put", "key": "@batch", "value": 1}': ("@batch: ", "drone/…/cmd/…"),
    b'{"op": "put", "key": "a/*", "value": 1}': ("'a/*'",),
    b'{"op": "put", "key": "a//b", "value": 1}': ("key is 'a//b'", "must be a/b"),
    b'{"op": "put", "key": "mine", "value": 36893488147419103232}': ("mine: ", "64-bit"),
    b'{"op": "subscribe", "key": "a//b"}': ("key is 'a//b'", "must be a/b"),
    b'{"op": "unsubscribe", "key": "clock"}': ("unsubscribe: ", "'clock'"),
    b'{"op": "join", "name": "a", "period_s": 0.021}': ("join: period_s is 0.021", "0.02"),
    b'{"op": "join", "name": "A b", "period_s": 0.02}': ("name is 'A b'", "48"),
    b'{"op": "join", "name": "a", "period_s": 0.02, "gates": ["drone/*/truth"]}': ("join: gates ", "wildcard"),
    b'{"op": "done", "t_ns": 0}': ("done: ", "join"),
    b'{"op": "leave"}': ("leave: ",),
    b'{"op": "hello", "nmae": "x"}': ("nmae",),
    b"[" * 2000: ("request: ",),
    b'{"op": "put", "key": "drone/drone1/cmd/mode", "value": {"mode": "land", "t_ns": NaN}}': ("request: ",),
}


def test_an_invalid_request_is_refused_and_the_connection_stays_open(stream):
    stream.request("hello")
    for line, terms in REFUSED.items():
        stream.send_line(line)
        error = stream.next("error")["error"]
        assert has_terms(error, *terms), line
        assert "\n" not in error
        assert stream.request("hello")["op"] == "hello"


def test_a_connection_that_does_not_begin_with_json_is_closed(gateway):
    with gateway.connect() as stream:  # as a web page could make a browser post to this port
        stream.send_line(
            b"POST / HTTP/1.1\r\n\r\n" + b'{"op": "put", "key": "drone/drone1/cmd/mode", "value": {"mode": "takeoff"}}'
        )
        assert "JSON" in stream.next("error")["error"]
        assert stream.is_at_end()


def test_an_overlong_line_closes_the_connection(gateway):
    with gateway.connect() as stream:
        with suppress(ConnectionError):  # the gateway closes while the rest is being sent
            stream.send_line(b'{"op": "hello", "name": "' + b"x" * 1_100_000)
        assert "longer than" in stream.next("error")["error"]
        assert stream.is_at_end()


def test_a_slow_client_loses_the_oldest_values_and_is_notified(gateway):
    with gateway.connect() as slow, gateway.connect() as other:
        assert slow.request("subscribe", key="my/flood")["op"] == "subscribe"
        text = "x" * 500_000
        for number in range(40):
            other.request("put", key="my/flood", value={"n": number, "text": text})
        lost = slow.next("lost")["lines"]
        assert lost > 0
        while slow.next("value")["value"]["n"] != 39:
            pass


def test_the_values_of_user_keys_may_be_any_json(stream):
    stream.request("subscribe", key="my/**")
    for value in (1, "text", [1, None], {"a": {"b": 2.5}}):
        stream.send("put", key="my/key", value=value, quiet=True)
        assert stream.next("value") == {"op": "value", "key": "my/key", "value": value}


def test_whole_numbers_may_be_written_as_doubles(stream):
    value = {"t_ns": 2e7, "seq": 3.0, "velocity_m_s": [0, 0, 0], "yaw_rate_rad_s": 0.0}
    stream.send("subscribe", key="drone/drone1/cmd/velocity")
    stream.send("put", key="drone/drone1/cmd/velocity", value=value, quiet=True)
    assert (stream.next("value")["value"]["t_ns"], type(value["t_ns"])) == (20_000_000, float)


def test_a_websocket_speaks_the_same_protocol(gateway):
    async def talk() -> tuple[dict[str, Any], dict[str, Any]]:
        async with aiohttp.ClientSession() as session, session.ws_connect(f"{gateway.url}/stream") as socket:
            await socket.send_json({"op": "hello", "name": "page"})
            hello = await socket.receive_json()
            await socket.send_json({"op": "subscribe", "key": "clock"})
            await socket.receive_json()
            return hello, await socket.receive_json()

    hello, value = asyncio.run(talk())
    assert (hello["name"], value["key"]) == ("client.page", "clock")


# HTTP


def test_the_json_tree_supports_get_put_post_and_streams(gateway):
    imu = gateway.http("GET", "/json/drone/drone1/sensor/imu")
    assert (imu.status, imu.headers["content-type"]) == (200, "application/json")
    assert len(imu.json()["accel_m_s2"]) == 3
    assert [entry["key"] for entry in gateway.http("GET", "/json/drone/*/truth").json()] == ["drone/drone1/truth"]
    assert gateway.http("GET", "/json/nobody/says").status == 404
    assert gateway.http("PUT", "/json/my/thing", {"a": 1}).json() == {}
    answer = gateway.http("POST", "/json/world/control", {"op": "nope", "args": {}})
    assert (answer.status, answer.json()["ok"]) == (200, False)
    with gateway.events("/json/clock") as events:
        kind, event = next(events)
        assert (kind, event["key"]) == ("PUT", "clock")


def test_the_zenoh_tree_answers_as_the_plugin_does(gateway):
    (entry,) = gateway.http("GET", "/zsim/world/info").json()
    assert (entry["key"], entry["encoding"]) == ("zsim/world/info", "application/msgpack;Info")
    assert msgpack.unpackb(base64.b64decode(entry["value"]))["federation"] == "zsim"
    raw = gateway.http("GET", "/zsim/world/info?_raw")
    assert raw.headers["content-type"] == "application/msgpack;Info"
    assert msgpack.unpackb(raw.body)["contract"] == 1
    assert gateway.http("GET", "/nobody/there").json() == []
    assert gateway.http("GET", "/nobody/there", headers={"Accept": "text/html"}).body == b"<dl>\n\n</dl>\n"
    assert gateway.http("GET", "/a//b").status == 400


def test_the_zenoh_tree_streams_puts_and_deletions(gateway):
    with gateway.events("/my/tree/**") as events:
        for body, kind, value in (
            (b'{"a": 1}', "application/json", {"a": 1}),
            (b"hi", "text/plain", "hi"),
            (b"\x00\x01", "application/octet-stream", "AAE="),
            (b"{", "application/json", "ew=="),
        ):
            done = gateway.http("PUT", "/my/tree/x", body, {"Content-Type": kind})
            assert (done.status, done.body) == (200, b"")
            event, data = next(events)
            assert (event, data["key"], data["value"], data["encoding"]) == ("PUT", "my/tree/x", value, kind)
            assert set(data) == {"key", "value", "encoding", "timestamp"}
        assert gateway.http("PATCH", "/my/tree/x", b"\x00").status == 200
        assert next(events)[1]["encoding"] == "zenoh/bytes"
        assert gateway.http("DELETE", "/my/tree/x").status == 200
        event, data = next(events)
        assert (event, data["value"]) == ("DELETE", None)


def test_a_put_value_is_returned_unchanged_until_it_is_deleted(gateway):
    for body, kind, value in ((b'{"a": 1}', "application/json", {"a": 1}), (b"hi", "text/plain", "hi")):
        gateway.http("PUT", "/zsim/my/own", body, {"Content-Type": kind})
        (entry,) = gateway.http("GET", "/zsim/my/own").json()
        assert (entry["value"], entry["encoding"]) == (value, kind)
        assert gateway.http("GET", "/json/my/own").json() == value
        raw = gateway.http("GET", "/zsim/my/own?_raw")
        assert (raw.body, raw.headers["content-type"].partition(";")[0]) == (body, kind)
    assert gateway.http("DELETE", "/zsim/my/own").status == 200
    assert gateway.http("GET", "/zsim/my/own").json() == []
    assert gateway.http("GET", "/json/my/own").status == 404


def test_views_can_be_read_as_last_values(gateway, stream):
    stream.send("subscribe", key="view/drones")
    stream.next("value")
    assert gateway.http("GET", "/json/view/drones").json()["drones"][0]["name"] == "drone1"


def test_puts_to_keys_of_another_federations_world_are_forbidden(gateway):
    assert gateway.http("PUT", "/other/clock", b"x").status == 403
    assert gateway.http("PUT", "/other/process/world/bye", b"x").status == 403


def test_a_command_through_the_zenoh_tree_is_checked(gateway):
    mode = {"t_ns": 0, "seq": 0, "source": "script", "mode": "land"}
    kind = {"Content-Type": "application/msgpack;Mode"}
    assert gateway.http("PUT", "/zsim/drone/drone1/cmd/mode", msgpack.packb(mode), kind).status == 200
    refused = gateway.http("PUT", "/zsim/drone/drone1/cmd/mode", msgpack.packb({**mode, "mode": "up"}), kind)
    assert (refused.status, parts(refused.json()["error"])) == (400, ("mode", "'up'"))
    assert gateway.http("DELETE", "/zsim/clock").status == 403
    assert gateway.http("PUT", "/zsim/world/info", b"x").status == 403


BAD_REQUESTS = [
    ("PUT", "/json/world/info", {}, 405),
    ("PUT", "/json/drone/drone1/cmd/mode", b"{", 400),
    ("PUT", "/json/drone/ghost/cmd/mode", {"mode": "land"}, 404),
    ("POST", "/json/world/control", b"[]", 400),
    ("POST", "/json/drone/drone1/truth", {"op": "x"}, 405),
    ("DELETE", "/json/clock", None, 405),
    ("GET", "/json/a//b", None, 400),
    ("GET", "/json/%ff", None, 400),
    ("GET", "/json/", None, 400),
    ("PUT", "/json/my/big", b"1" * 1_100_000, 413),
    ("GET", "/@/**", None, 403),  # Zenoh's admin space, with the addresses of all connected sessions
    ("POST", "/%40/router/**", b"1", 403),
]
OTHER_SITES = [
    {"Origin": "http://evil.example"},
    {"Host": "evil.example"},
    {"Origin": "http://localhost:3000"},  # another server on this machine
    {"Origin": "null"},  # a sandboxed frame, which any page can create
]


def test_bad_requests_and_requests_from_other_sites_are_refused(gateway):
    for method, path, body, status in BAD_REQUESTS:
        answer = gateway.http(method, path, body)
        assert answer.status == status, (path, answer.body)
        assert answer.json()["error"]
    for headers in OTHER_SITES:
        assert gateway.http("GET", "/json/clock", headers=headers).status == 403, headers


def test_idle_connections_do_not_lock_out_others(gateway):
    with ExitStack() as stack:
        halves = []
        for _ in range(STRANGERS_MAX + 1):
            half = stack.enter_context(socket.create_connection(("127.0.0.1", gateway.http_port), PATIENCE_S))
            half.sendall(b"GET /json/clock HTTP/1.1\r\nHost: localhost\r\n")
            halves.append(half)
        with suppress(ConnectionResetError):
            assert halves[0].recv(1) == b""
        assert gateway.http("GET", "/json/clock").status == 200


# Lockstep sessions


def fly(gateway: GatewayProcess, between: Callable[[], None] = lambda: None) -> int:
    """Take off and climb in a lockstep session until the run ends; return the number of gates.

    Args:
        gateway: The gateway to connect to.
        between: Called while a gate is open.
    """
    gates = 0
    with gateway.connect() as stream:
        joined = stream.request("join", name="pilot", period_s=0.02, reads=["drone/drone1/sensor/*"])
        assert (joined["op"], joined["name"]) == ("join", PILOT), joined
        while (message := stream.next("gate", "left"))["op"] == "gate":
            status = message["inputs"][-1]
            assert status["key"] == "drone/drone1/sensor/status"
            assert status["value"]["t_ns"] == message["t_ns"] == gates * GATE_NS
            assert status["value"]["count"] == len(message["inputs"])
            between()
            mode = {"key": "drone/drone1/cmd/mode", "value": {"mode": "takeoff"}}
            up = {"key": "drone/drone1/cmd/velocity", "value": {"velocity_m_s": [0.2, 0, 0.5], "yaw_rate_rad_s": 0.1}}
            mark = {"key": "my/mark", "value": gates}
            stream.send("done", t_ns=message["t_ns"], outputs=[mode, mark] if gates < 2 else [up])
            gates += 1
        assert message["reason"] == "the run ended"
    return gates


def test_two_lockstep_sessions_are_bit_identical(tmp_path):
    hashes = []
    for number in range(2):
        with Federation(tmp_path / str(number)) as federation:
            federation.folder.mkdir()
            world = federation.world(FLOWN, "--expect", "recorder")
            federation.role("record", "--out", str(federation.out))
            assert fly(GatewayProcess(federation).in_run()) == 201
            world.ends(with_code=0)
            record = federation.record()
            hashes.append(record.sha256())
            assert record.all("drone/drone1/truth")[-1]["position_m"][2] > 0.3
            assert record.all("my/mark") == [0, 1]
    assert hashes[0] == hashes[1]


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Iterator[GatewayProcess]:
    """The gateway of a world that waits for a pilot and continues in real time once the pilot has left."""
    with Federation(tmp_path_factory.mktemp("standing")) as federation:
        federation.world(STANDING, "--rate", "1")
        yield GatewayProcess(federation).in_run()


def join(stream: LineConnection) -> dict[str, Any]:
    """Join as the pilot; return the first gate."""
    joined = stream.request("join", name="pilot", period_s=0.02, reads=["drone/drone1/truth"])
    assert (joined["op"], joined["gates"]) == ("join", ["drone/drone1/truth"]), joined
    return stream.next("gate")


def test_a_refused_done_leaves_the_gate_open(standing):
    with standing.connect() as stream:
        first_ns = join(stream)["t_ns"]
        bad = [
            {"key": "drone/drone1/cmd/mode", "value": {"mode": "takeoff"}},
            {"key": "drone/drone1/cmd/mode", "value": {"mode": "up"}},
        ]
        assert parts(stream.request("done", t_ns=first_ns, outputs=bad)["error"]) == ("mode", "'up'")
        for key in ("drone/drone1/cmd/foo", "my//bad"):
            outputs = [{"key": "my/ok", "value": 1}, {"key": key, "value": {}}]
            assert "error" in stream.request("done", t_ns=first_ns, outputs=outputs)
        assert stream.request("latest", key="my/ok")["values"] == []
        assert f"must be {first_ns}" in stream.request("done", t_ns=first_ns + GATE_NS)["error"]
        assert "already" in stream.request("join", name="other", period_s=0.02)["error"]
        stream.send("done", t_ns=first_ns, outputs=bad[:1])
        assert stream.next("gate")["t_ns"] == first_ns + GATE_NS
        assert stream.request("leave")["op"] == "leave"


def test_a_gate_of_a_former_session_is_refused(standing):
    with standing.connect() as stream:
        for _ in range(3):
            gate = join(stream)
            stream.send("done", t_ns=gate["t_ns"])
            assert stream.request("leave")["op"] == "leave"
            refused = stream.request("done", t_ns=gate["t_ns"] + GATE_NS)
            assert has_terms(refused["error"], "done: ", "join")


def test_a_second_session_with_the_same_name_replaces_the_first(standing):
    with standing.connect() as first, standing.connect() as second:
        for stream in (first, second):
            join(stream)
        assert "another" in first.next("left")["reason"]
        assert "is 'gateway.main'" in first.request("join", name="gateway.main", period_s=0.02)["error"]


def test_the_world_reports_a_disconnected_client_and_lets_it_rejoin(federation):
    federation.world(STANDING.replace("processes: {", "processes: {on_death: {client: wait}, "))
    gateway, events = GatewayProcess(federation).in_run(), federation.client().subscribe("world/event")
    with gateway.connect() as stream:
        stream.request("join", name="pilot", period_s=0.02, reads=["drone/drone1/truth"])
        stream.next("gate")
    assert events.until(lambda e: e["kind"] == "death").message["subject"] == PILOT
    with gateway.connect() as stream:
        stream.request("join", name="pilot", period_s=0.02, reads=["drone/drone1/truth"])
        gate = stream.next("gate")
        stream.send("done", t_ns=gate["t_ns"])
        assert stream.next("gate")["t_ns"] == gate["t_ns"] + GATE_NS
        assert stream.request("leave")["op"] == "leave"
    assert events.until(lambda e: e["kind"] == "leave").message["subject"] == PILOT


# Beginnings and ends of runs and gateways


def test_clients_stay_while_runs_come_and_go(federation):
    gateway = GatewayProcess(federation)
    with gateway.connect() as stream:
        assert stream.request("hello", name="patient")["run_id"] is None
        assert "error" in stream.request("latest", key="clock")
        assert gateway.http("GET", "/json/clock").status == 503
        stream.send("subscribe", key="clock")
        for _ in range(2):
            world = federation.world(STANDING, "--realtime")
            begun = stream.next("run")
            assert begun["state"] == "begun"
            stream.send("ask", key="world/control", request="stop")
            ended = stream.next("run")
            assert (ended["state"], ended["run_id"]) == ("ended", begun["run_id"])
            world.ends(with_code=0)


@pytest.mark.soak
def test_a_session_ends_with_its_run_despite_an_unanswered_gate(federation):
    world = federation.world(STANDING)
    gateway = GatewayProcess(federation).in_run()
    with gateway.connect() as stream:
        for _ in range(2):
            assert stream.request("join", name="pilot", period_s=0.02, reads=["drone/drone1/truth"])["op"] == "join"
            stream.next("gate")
            stream.send("ask", key="world/control", request="stop")
            assert "ended" in stream.next("left")["reason"]
            world.ends(with_code=0)
            world = federation.world(STANDING)
            while stream.next("run")["state"] != "begun":
                pass


def test_clients_are_notified_of_a_killed_world(federation):
    world = federation.world(STANDING)
    gateway = GatewayProcess(federation).in_run()
    with gateway.connect() as stream:
        stream.request("hello")
        world.signal(signal.SIGKILL)
        assert stream.next("run")["state"] == "lost"
        world.ends(with_code=-signal.SIGKILL)
        federation.world(STANDING)
        assert [stream.next("run")["state"] for _ in range(3)] == ["back", "ended", "begun"]


def test_ctrl_c_ends_the_gateway_with_a_bye(federation):
    federation.world(STANDING)
    gateway, byes = GatewayProcess(federation).in_run(), federation.client().subscribe("process/gateway.main/bye")
    with gateway.connect() as stream:
        stream.request("join", name="pilot", period_s=0.02, reads=["drone/drone1/truth"])
        stream.next("gate")
        gateway.role.signal(signal.SIGINT)
        assert "Ctrl-C" in byes.until(lambda bye: True).message["reason"]
        gateway.role.ends(with_code=0)
        assert stream.is_at_end()


def test_a_second_gateway_of_the_same_name_takes_over(federation):
    federation.world(STANDING)
    first = GatewayProcess(federation).in_run()
    GatewayProcess(federation).in_run()
    first.role.ends(with_code=3)
    assert "gateway.main: another" in first.role.text()


def test_a_port_in_use_is_reported(federation):
    gateway = GatewayProcess(federation)
    second = federation.role("gateway", "--http", str(gateway.http_port), "--lines", str(gateway.lines_port))
    second.ends(with_code=2)
    assert has_terms(second.text(), str(gateway.http_port), "--http", "--lines")


# Access control


def test_an_empty_token_is_refused(federation):
    refused = federation.role("gateway", "--token", "")
    refused.ends(with_code=2)
    assert has_terms(refused.text(), "token", "empty")


def test_listening_off_loopback_requires_a_token(federation):
    refused = federation.role("gateway", "--listen", "0.0.0.0")
    refused.ends(with_code=2)
    (line,) = refused.text().splitlines()
    assert has_terms(line, "gateway: ", "0.0.0.0", "--token", "--listen 127.0.0.1")


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Iterator[GatewayProcess]:
    """A gateway that requires a token."""
    with Federation(tmp_path_factory.mktemp("guarded")) as federation:
        federation.world(STANDING)
        yield GatewayProcess(federation, "--listen", "0.0.0.0", "--token", "open sesame").in_run()


def test_a_token_is_required_on_every_port(guarded):
    assert guarded.http("GET", "/json/clock").status == 401
    assert guarded.http("GET", "/json/clock", headers={"Authorization": "Bearer wrong"}).status == 401
    shown = {"Authorization": "Bearer open sesame"}
    assert guarded.http("GET", "/json/clock", headers=shown).status == 200
    page = {"Origin": "http://page.example"}
    assert guarded.http("GET", "/json/clock?token=open%20sesame", headers=page).status == 200
    assert guarded.http("OPTIONS", "/json/clock", headers=page).status == 204
    with guarded.connect() as stream:
        assert "token" in stream.request("latest", key="clock")["error"]
        assert stream.request("hello", token="open sesame")["op"] == "hello"
        assert stream.request("latest", key="clock")["op"] == "latest"
    with guarded.connect() as stream:
        assert "token" in stream.request("hello", token="x")["error"]
        assert stream.is_at_end()
    with guarded.connect() as stream:
        assert "token" in stream.next("error")["error"]
        assert stream.is_at_end()


def test_clients_with_the_token_are_served_despite_idle_connections(guarded):
    """Others send half a request or nothing on more connections than each port allows without a token."""
    with ExitStack() as stack:
        for port, most in ((guarded.http_port, STRANGERS_MAX), (guarded.lines_port, UNAUTHENTICATED_MAX)):
            for _ in range(most + 1):
                half = stack.enter_context(socket.create_connection(("127.0.0.1", port), PATIENCE_S))
                half.sendall(b"GET /json/clock HTTP/1.1" if port == guarded.http_port else b"")
        shown = {"Authorization": "Bearer open sesame"}
        assert guarded.http("GET", "/json/clock", headers=shown).status == 200
        with guarded.connect() as stream:
            assert stream.request("hello", token="open sesame")["op"] == "hello"
            assert stream.request("latest", key="clock")["op"] == "latest"


def test_invalid_header_bytes_are_refused(guarded):
    for headers in (
        {"Authorization": "Bearer \xff"},
        {"Authorization": "Bearer open sesame", "Content-Type": "a/\xff"},
    ):
        answer = guarded.http("PUT", "/my/key", b"x", headers)
        assert answer.status in (400, 401), answer
    assert "failed" not in guarded.role.text()
