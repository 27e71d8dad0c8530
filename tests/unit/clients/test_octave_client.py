"""The MATLAB client, run by GNU Octave, against a gateway with scripted answers."""

import json
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from octave import command, needs_octave, run
from refused import has_terms

pytestmark = needs_octave

PATIENCE_S = 120.0
RUN = {
    "run_id": "abc", "federation": "zsim", "mode": "lockstep", "gate_s": 0.02, "t_ns": 0,
    "drones": ["drone1"], "clusters": [{"name": "main", "drones": ["drone1"]}],
}  # fmt: skip
JsonMap = dict[str, Any]
Answer = Callable[[JsonMap], list[JsonMap | bytes]]


class FakeGateway:
    """Accepts one connection and answers `hello` by `hello` and every other line by `answer`."""

    def __init__(self, answer: Answer, hello: Answer | None = None, listener: socket.socket | None = None) -> None:
        self._answer = answer
        self._hello = hello or (lambda asked: [{"op": "hello", "name": "client.test", **RUN}])
        self._listener = listener or socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(PATIENCE_S)
        self.port = self._listener.getsockname()[1]
        self.requests: list[JsonMap] = []
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        link, _ = self._listener.accept()
        with link, link.makefile("rb") as lines:
            link.settimeout(PATIENCE_S)
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for line in lines:
                asked = json.loads(line)
                self.requests.append(asked)
                answers = (self._hello if asked["op"] == "hello" else self._answer)(asked)
                if not answers:
                    return
                for reply in answers:
                    link.sendall(reply if isinstance(reply, bytes) else _line(reply, asked))

    def close(self) -> None:
        self._thread.join(PATIENCE_S)
        self._listener.close()


def _line(reply: JsonMap, asked: JsonMap) -> bytes:
    """Return a line, which has the ID of the request unless its message is unsolicited."""
    answered = {} if reply["op"] in ("value", "gate", "left", "lost", "run") else {"id": asked.get("id")}
    return json.dumps({**reply, **answered}, separators=(",", ":"), ensure_ascii=False).encode() + b"\n"


@contextmanager
def gateway(answer: Answer, hello: Answer | None = None) -> Iterator[FakeGateway]:
    made = FakeGateway(answer, hello)
    try:
        yield made
    finally:
        made.close()


def reply(port: int, code: str) -> list[str]:
    """Return the lines that code prints, with `c` a client connected to the port."""
    return run(f"c = zsim.Client('127.0.0.1', 'Port', {port}, 'Timeout', 5); {code} c.delete();").splitlines()


def echo(asked: JsonMap) -> list[JsonMap | bytes]:
    return [{"op": asked["op"], "key": asked.get("key")}]


def test_each_method_sends_the_request_that_the_gateway_expects() -> None:
    """Times stay integers, and lists of one element stay lists."""
    code = """
    c.put('any/key', struct('t_ns', 330000000000, 'list', {{'one'}}));
    c.velocity('drone1', [1; 2; 0.25], 0.5);
    c.velocity('drone1', [0 0 1], 0, 'world');
    c.takeoff(); c.land('drone1');
    c.subscribe('drone/*/truth'); c.unsubscribe('drone/*/truth');
    """
    with gateway(echo) as fake:
        reply(fake.port, code)
    (hello, *rest) = [{k: v for k, v in asked.items() if k != "id"} for asked in fake.requests]
    assert (hello["op"], hello["name"]) == ("hello", "")
    assert rest == [
        {"op": "put", "key": "any/key", "value": {"t_ns": 330000000000, "list": ["one"]}},
        {
            "op": "put",
            "key": "drone/drone1/cmd/velocity",
            "value": {"velocity_m_s": [1, 2, 0.25], "yaw_rate_rad_s": 0.5},
        },
        {
            "op": "put",
            "key": "drone/drone1/cmd/velocity",
            "value": {"velocity_m_s": [0, 0, 1], "yaw_rate_rad_s": 0, "frame": "world"},
        },
        {"op": "put", "key": "drone/drone1/cmd/mode", "value": {"mode": "takeoff"}},
        {"op": "put", "key": "drone/drone1/cmd/mode", "value": {"mode": "land"}},
        {"op": "subscribe", "key": "drone/*/truth"},
        {"op": "unsubscribe", "key": "drone/*/truth"},
    ]
    assert isinstance(rest[0]["value"]["t_ns"], int)


def test_requests_reach_the_world_and_a_cluster() -> None:
    code = """
    c.pause(); c.advance(3); c.resume(); c.rate(2); c.stop('done');
    c.clusterTarget('main', struct('z_c', 10), 20); c.clusterHold('main'); c.clusterRejoin('main');
    c.acquire('drone1', 10); r = c.ask('world/control', 'step', struct('gates', 1)); disp(r.at);
    """

    def answer(asked: JsonMap) -> list[JsonMap | bytes]:
        return [{"op": "answer", "ok": True, "error": "", "result": {"at": [1, 2, 3]}}]

    with gateway(answer) as fake:
        assert reply(fake.port, code) == ["   1   2   3"]
    asked = [(a["key"], a["request"], a["args"]) for a in fake.requests[1:]]
    assert asked == [
        ("world/control", "pause", {}),
        ("world/control", "step", {"gates": 3}),
        ("world/control", "resume", {}),
        ("world/control", "rate", {"value": 2}),
        ("world/control", "stop", {"reason": "done"}),
        ("cluster/main/control", "target", {"values": {"z_c": 10}, "over_s": 20}),
        ("cluster/main/control", "hold", {}),
        ("cluster/main/control", "rejoin", {}),
        ("world/control", "acquire", {"drone": "drone1", "priority": 10}),
        ("world/control", "step", {"gates": 1}),
    ]


def test_lines_are_read_however_they_are_split() -> None:
    """An answer of 1 MB in pieces, one byte by byte that splits a character, and many lines in one piece."""

    def answer(asked: JsonMap) -> list[JsonMap | bytes]:
        value = {"text": "ü" * 500_000 if asked["key"] == "long" else "grün", "v": [1, 2, 3]}
        entry = {"key": asked["key"], "value": value}
        line = _line({"op": "latest", "values": [entry]}, asked)
        values = b"".join(_line({"op": "value", "key": f"k{i}", "value": i}, asked) for i in range(1000))
        step = 10_007 if asked["key"] == "long" else 1
        return [*(line[i : i + step] for i in range(0, len(line), step)), values]

    code = """
    a = c.latest('long'); b = c.latest('short');
    printf('%d %s %d\\n', numel(a.text), b.text, b.v(3));
    for k = 0:1999
        [value, key] = c.next(5);
        assert(value == mod(k, 1000) && strcmp(key, sprintf('k%d', value)));
    end
    """
    with gateway(answer) as fake:
        assert reply(fake.port, code) == ["1000000 grün 3"]


def test_missing_values_and_news_are_empty() -> None:
    """They are not errors."""

    def answer(asked: JsonMap) -> list[JsonMap | bytes]:
        return [{"op": "latest", "values": []}]

    code = """
    disp(isempty(c.imu('drone1'))); disp(size(c.latest('drone/*/truth')));
    [value, key] = c.next(0.05); disp(isempty(value) && isempty(key));
    """
    with gateway(answer) as fake:
        assert reply(fake.port, code) == ["1", "   0   0", "1"]


FAILS = "try, {code} catch e, printf('%s %s\\n', e.identifier, e.message); end;"


def test_a_refusal_and_a_closed_connection_are_different_errors() -> None:
    """The client can continue after a refusal."""

    def answer(asked: JsonMap) -> list[JsonMap | bytes]:
        if asked["op"] == "put":
            return [{"op": "error", "error": "drone/drone9: drone is 'drone9'; must be one of drone1"}]
        if asked["op"] == "ask":
            return [{"op": "answer", "ok": False, "error": "phase is idle", "result": None}]
        return []

    code = "".join(
        FAILS.format(code=tried)
        for tried in (
            "c.velocity('drone9', [0 0 0], 0);",
            "c.clusterLand('main');",
            "c.velocity('drone1', [0 0], 0);",
            "c.velocity('drone1', [0 0 NaN], 0);",
            "c.step();",
            "c.truth('drone1');",
            "c.truth('drone1');",
        )
    )
    with gateway(answer) as fake:
        lines = reply(fake.port, code)
    terms_of_each = [
        ("zsim:refused", "drone/drone9", "'drone9'", "drone1"),
        ("zsim:refused", "cluster/main/control land", "phase is idle"),
        ("zsim:argument", "velocity", "2", "3", "x", "y", "z"),
        ("zsim:argument", "drone1", "finite"),
        ("zsim:refused", "step", "not joined", "join"),
        ("zsim:connection", "gateway", f"127.0.0.1:{fake.port}", "zsim.Client"),
        ("zsim:connection", f"127.0.0.1:{fake.port}", "closed", "zsim.Client"),
    ]
    for line, terms in zip(lines, terms_of_each, strict=True):
        assert has_terms(line, *terms)


def test_a_missing_answer_times_out_and_a_late_one_is_ignored() -> None:
    """The late refusal does not affect the next request."""
    first: list[int] = []

    def answer(asked: JsonMap) -> list[JsonMap | bytes]:
        if not first:
            first.append(asked["id"])
            return [b"\n"]
        late = json.dumps({"op": "error", "error": "late", "id": first[0]}).encode() + b"\n"
        return [late, {"op": "put", "key": asked["key"]}]

    with gateway(answer) as fake:
        made = f"c = zsim.Client('127.0.0.1', 'Port', {fake.port}, 'Timeout', 2.5);"
        text = run(made + FAILS.format(code="c.put('a', 1);") + "c.put('b', 2); disp('goes on'); c.delete();")
    late, after = text.splitlines()
    assert has_terms(late, "zsim:timeout", "put", f"127.0.0.1:{fake.port}", "2.5 s")
    assert after == "goes on"


def test_the_client_waits_for_a_run_to_begin() -> None:
    """It waits as long as its option allows, and then knows the drones."""
    asked_before: list[JsonMap] = []

    def hello(asked: JsonMap) -> list[JsonMap | bytes]:
        asked_before.append(asked)
        if len(asked_before) == 1:
            return [
                {"op": "hello", "name": "client.test", "run_id": None},
                {"op": "run", "state": "begun", "run_id": "abc"},
            ]
        return [{"op": "hello", "name": "client.test", **RUN}]

    with gateway(echo, hello) as fake:
        lines = reply(fake.port, "disp(c.run.run_id); disp(c.run.drones{1}); disp(c.run.clusters(1).name);")
        assert lines == ["abc", "drone1", "main"]

    def never(asked: JsonMap) -> list[JsonMap | bytes]:
        return [{"op": "hello", "name": "client.test", "run_id": None}]

    with gateway(echo, never) as fake:
        text = run(FAILS.format(code=f"zsim.Client('127.0.0.1', 'Port', {fake.port}, 'Wait', 0.2);"))
    assert has_terms(text, "zsim:timeout", f"127.0.0.1:{fake.port}", "0.2 s", "zsim run")


def test_the_client_steps_in_lockstep() -> None:
    """Messages sent during a gate are its answer; a refused answer leaves the gate open; `left` ends the lockstep."""
    gates = iter(range(1, 10))

    def answer(asked: JsonMap) -> list[JsonMap | bytes]:
        gate = {"op": "gate", "t_ns": 20_000_000 * next(gates), "inputs": []}
        entry = {"key": "drone/drone1/estimate", "value": {"position_m": [1, 2, 3]}}
        match asked["op"]:
            case "join":
                return [{"op": "join", "name": "client.x", "gates": ["clock"]}, {**gate, "t_ns": 0, "inputs": [entry]}]
            case "done" if any(output["key"] == "bad" for output in asked["outputs"]):
                return [{"op": "error", "error": "done: 'bad'"}]
            case "done" if asked["t_ns"] >= 80_000_000:
                return [{"op": "left", "reason": "over"}]
        return [{**gate, "inputs": [entry, {"key": "b", "value": 1}]}]

    code = f"""
    disp(c.join('x', 0.02, 'drone/drone1/estimate'){{1}});
    gate = c.step();
    e = zsim.heard(gate, 'drone/drone1/estimate');
    printf('%g %d\\n', gate.t_s, e.position_m(3));
    c.velocity('drone1', [1 0 0], 0);
    gate = c.step({{'k', 1; 'l', struct('m', 2)}});
    c.put('bad', 1);
    {FAILS.format(code="c.step();")}
    c.put('good', 1);
    while ~isempty(gate)
        gate = c.step();
    end
    disp(c.left);
    """
    with gateway(answer) as fake:
        assert reply(fake.port, code) == ["clock", "0 3", "zsim:refused done: 'bad'", "over"]
    join, *dones = [asked for asked in fake.requests if asked["op"] in ("join", "done")]
    assert join["reads"] == ["drone/drone1/estimate"]
    velocity = {"velocity_m_s": [1, 0, 0], "yaw_rate_rad_s": 0}
    assert [output["key"] for output in dones[0]["outputs"]] == ["drone/drone1/cmd/velocity", "k", "l"]
    assert dones[0]["outputs"][0]["value"] == velocity
    assert [output["key"] for output in dones[2]["outputs"]] == ["good"]
    assert [done["t_ns"] for done in dones[:3]] == [0, 40_000_000, 40_000_000]
    assert all(isinstance(done["t_ns"], int) for done in dones)


def test_the_client_waits_for_a_gateway_to_start() -> None:
    """Like the C client, it retries until the gateway listens."""
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))  # not yet listening: connections are refused
    port = listener.getsockname()[1]
    code = FAILS.format(code=f"zsim.Client('127.0.0.1', 'Port', {port}, 'Wait', 0);")
    code += f"fflush(stdout); c = zsim.Client('127.0.0.1', 'Port', {port}, 'Wait', {PATIENCE_S}); disp(c.name);"
    with subprocess.Popen(command(code), stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        nobody = program.stdout.readline()
        listener.listen()
        fake = FakeGateway(echo, listener=listener)
        after, _ = program.communicate(timeout=PATIENCE_S)
    fake.close()
    assert has_terms(nobody, "zsim:connection", f"127.0.0.1:{port}", "`zsim gateway`")
    assert after == "client.test\n"


def test_faults_before_a_connection_are_errors() -> None:
    """An absent gateway is an error after `Wait`, and a fault that waiting cannot mend is one at once."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    tried = (
        f"zsim.Client('127.0.0.1', 'Port', {port}, 'Wait', 0.2);",
        "zsim.Client('no.such.host.invalid');",
        "zsim.Client('127.0.0.1', 'Prt', 1);",
    )
    nobody, unknown, wrong = run("".join(FAILS.format(code=each) for each in tried)).splitlines()
    assert has_terms(nobody, "zsim:connection", f"127.0.0.1:{port}", "`zsim gateway`")
    assert has_terms(unknown, "zsim:connection", "no.such.host.invalid")
    assert has_terms(wrong, "zsim:argument", "'Prt'", "unknown", "Port", "Token", "Name", "Timeout", "Wait")


def test_the_matlab_tests_pass() -> None:
    """These are clients/matlab/tests, run as a user would."""
    lines = run("run_tests()").splitlines()
    assert lines
    assert all(line.startswith("ok ") for line in lines)
