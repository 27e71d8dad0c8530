"""The C client: its JSON reader, its calls to a fake gateway, and flights through a real one."""

import json
import os
import random
import re
import shutil
import subprocess
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fake_gateway import HELLO, FakeGateway
from federation import ONE, Federation
from forked_commands import ROOT
from gateway_process import GatewayProcess
from refused import has_terms, parts
from wire import PATIENCE_S

HERE = ROOT / "clients" / "c"
GCC = shutil.which("gcc")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-Wconversion")
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
SMALL = ("-DZSIM_LINE_MAX=1024",)
LOCALES = {"de_DE": "a decimal comma", "ps_AF": "a decimal point of two bytes"}
ESTIMATE = {
    "op": "gate", "t_ns": 20_000_000, "inputs": [
        {"key": "drone/drone1/estimate", "value": {"t_ns": 0, "position_m": [0.1, -2.5e-3, 1], "state": "flä\n"}},
        {"key": "drone/drone1/estimate", "value": {"t_ns": 20_000_000, "position_m": [1, 2, 3], "sensors": {"gps": [1, 0]}}},
    ],
}  # fmt: skip
SQUARE = ONE.replace("expect: []", "expect: [estimator.drone1, client.square]")

pytestmark = pytest.mark.skipif(GCC is None, reason="gcc is not installed; on Debian: apt-get install gcc libc6-dev")
Build = Callable[..., Path]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """Return a function that compiles a program and the client with strict warnings, once for each set of flags."""
    folder = tmp_path_factory.mktemp("c")
    built: dict[tuple[str, ...], Path] = {}

    def compile_it(source: Path, *flags: str) -> Path:
        if (str(source), *flags) not in built:
            made = folder / f"{source.stem}-{len(built)}.o"
            output(GCC, *STRICT, *flags, f"-I{HERE}", "-c", source, "-o", made)
            built[str(source), *flags] = made
        return built[str(source), *flags]

    def link(source: str, *flags: str) -> Path:
        parts = [compile_it(each, *flags) for each in (ROOT / source, HERE / "zsim.c")]
        program = parts[0].with_suffix("")
        if not program.exists():
            output(GCC, *flags, *parts, "-lm", "-o", program)
        return program

    return link


def output(*command: object, **options: object) -> str:
    """Run a program, which must succeed, and return its output."""
    done = subprocess.run(
        [str(each) for each in command],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        **options,  # type: ignore[call-overload]
    )
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def locales(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return an environment in which the LOCALES are installed."""
    folder = tmp_path_factory.mktemp("locales")
    if shutil.which("localedef") is None or not all(Path("/usr/share/i18n/locales", each).exists() for each in LOCALES):
        pytest.skip("no sources of locales; on Debian: apt-get install locales")
    for each in LOCALES:
        subprocess.run(["localedef", "-i", each, "-f", "UTF-8", str(folder / f"{each}.UTF-8")], check=True)
    return {**os.environ, "LOCPATH": str(folder)}


# The JSON reader


def test_the_json_reader_passes_its_tests(build: Build) -> None:
    assert output(build("clients/c/tests/json_test.c", *SANITIZED)) == "decimal point ., 0 failures\n"


@pytest.mark.parametrize("name", LOCALES, ids=LOCALES.get)
def test_the_json_reader_is_independent_of_the_locale(build: Build, locales: dict[str, str], name: str) -> None:
    printed = output(build("clients/c/tests/json_test.c", *SANITIZED), f"{name}.UTF-8", env=locales)
    assert re.fullmatch(r"decimal point [^.]+, 0 failures\n", printed)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_json_reader_survives_any_bytes(build: Build, seed: int) -> None:
    printed = output(build("clients/c/tests/json_fuzz.c", *SANITIZED), seed, 5_000, input=json.dumps(ESTIMATE))
    lines, valid, values = map(int, re.findall(r"\d+", printed))
    assert lines == 5_000
    assert 50 < valid < 4_500  # the fuzzer corrupts some of the lines, not all
    assert values > 5_000


def test_a_windows_compiler_accepts_the_client(tmp_path: Path) -> None:
    compiler = shutil.which("x86_64-w64-mingw32-gcc")
    if compiler is None:
        pytest.skip("no compiler for Windows; on Debian: apt-get install gcc-mingw-w64-x86-64-win32")
    output(compiler, *STRICT[:-1], "-c", HERE / "zsim.c", "-o", tmp_path / "zsim.obj")


def test_the_header_compiles_as_cpp(tmp_path: Path) -> None:
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed; on Debian: apt-get install g++")
    source = tmp_path / "main.cpp"
    source.write_text(
        '#include "zsim.h"\nint main() { zsim_client c; return zsim_connect(&c, "", 0, "", 0, 0) > 0; }\n'
    )
    client = tmp_path / "zsim.o"
    output(GCC, *STRICT, "-c", HERE / "zsim.c", "-o", client)
    output(compiler, "-Wall", "-Wextra", "-Werror", "-pedantic", f"-I{HERE}", source, client, "-o", tmp_path / "main")


# The client, call by call


class Talk:
    """clients/c/tests/talk.c: makes the calls that it reads from its input."""

    def __init__(self, program: Path, *arguments: str, env: dict[str, str] | None = None) -> None:
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            [str(program), *arguments],
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            text=True,
            errors="replace",
            bufsize=1,
            env=env,
        )

    def calls(self, line: str) -> None:
        """Request a call."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")

    def returned(self) -> str:
        """Return the result of the call."""
        assert self._process.stdout is not None
        return self._process.stdout.readline().rstrip("\n")

    def does(self, line: str) -> str:
        """Request a call and return its result."""
        self.calls(line)
        return self.returned()

    def ends(self) -> None:
        """Close its input; it must exit with code 0."""
        try:
            _, printed = self._process.communicate(timeout=PATIENCE_S)
        finally:
            self._process.kill()
        assert self._process.returncode == 0, printed


@pytest.fixture
def fake() -> Iterator[FakeGateway]:
    with FakeGateway() as made:
        yield made


@pytest.fixture
def talk(build: Build) -> Iterator[Talk]:
    made = Talk(build("clients/c/tests/talk.c", *SANITIZED))
    yield made
    made.ends()


def connected(talk: Talk, fake: FakeGateway, timeout_s: float = PATIENCE_S) -> None:
    talk.calls(f"connect {fake.port} {timeout_s} me")
    fake.welcome()
    assert talk.returned() == "1 client.me r1 lockstep 0.02 1200000000"


def test_the_client_waits_for_a_run(talk: Talk, fake: FakeGateway) -> None:
    talk.calls(f"connect {fake.port} {PATIENCE_S} me secret")
    hello = fake.receive("hello")
    assert (hello["name"], hello["token"]) == ("me", "secret")
    fake.answer(hello, name="client.me", run_id=None)
    fake.send({"op": "run", "state": "begun", "run_id": "r1"})
    fake.welcome()
    assert talk.returned().startswith("1 client.me r1")


def test_connection_errors_are_reported_in_one_line(talk: Talk, fake: FakeGateway) -> None:
    assert has_terms(talk.does("connect 1 0.1 me"), "-1 zsim: ", "127.0.0.1:1", "`zsim gateway`")
    assert has_terms(talk.does("latest clock t_ns"), "-1 zsim: ", "connection")
    talk.calls(f"connect {fake.port} {PATIENCE_S} me")
    fake.send({"op": "error", "error": "hello: wrong\ntoken", "id": fake.receive("hello")["id"]})
    assert talk.returned() == "-1 hello: wrong token"


def test_values_are_queued_while_an_answer_is_awaited(talk: Talk, fake: FakeGateway) -> None:
    connected(talk, fake)
    talk.calls("subscribe drone/*/truth")
    fake.answer(fake.receive("subscribe"), key="drone/*/truth")
    assert talk.returned() == "1"
    talk.calls("latest clock t_ns")
    asked = fake.receive("latest")
    fake.send(*({"op": "value", "key": "a", "value": n} for n in (1, 2)))
    fake.answer(asked, values=[{"key": "clock", "value": {"t_ns": 7}}])
    fake.send({"op": "value", "key": "b", "value": [3]})
    assert talk.returned() == "1 7"
    assert [talk.does("next 60") for _ in range(3)] == ["1 a 1 lost 0", "1 a 2 lost 0", "1 b [3] lost 0"]
    assert talk.does("next 0") == "0"


def test_a_late_answer_is_discarded(talk: Talk, fake: FakeGateway) -> None:
    connected(talk, fake, timeout_s=5)
    talk.calls("latest clock t_ns")
    late = fake.receive("latest")
    assert has_terms(talk.returned(), "-1 zsim: ", "5.0 s")
    fake.answer(late, values=[{"key": "clock", "value": {"t_ns": 1}}])
    talk.calls("latest clock t_ns")
    fake.answer(fake.receive("latest"), values=[{"key": "clock", "value": {"t_ns": 2}}])
    assert talk.returned() == "1 2"
    talk.calls("latest nothing t_ns")
    fake.answer(fake.receive("latest"), values=[])
    assert talk.returned() == "0"


def test_a_setpoint_does_not_wait_and_the_next_call_reports_its_refusal(talk: Talk, fake: FakeGateway) -> None:
    connected(talk, fake)
    assert talk.does("velocity drone1 0.1 -2 1e-300 0.5") == "1"
    put = fake.receive("put")
    assert (put["key"], put["quiet"]) == ("drone/drone1/cmd/velocity", True)
    assert put["value"] == {"velocity_m_s": [0.1, -2, 1e-300], "yaw_rate_rad_s": 0.5}
    fake.send({"op": "error", "error": "drone/drone1/cmd/velocity: refused", "id": put["id"]})
    assert talk.does("next 60") == "-1 drone/drone1/cmd/velocity: refused"
    refused = talk.does("velocity drone1 0 nan 0 0")
    assert parts(refused) == ("velocity_m_s", "not finite")
    assert refused.startswith("-1 drone/drone1/cmd/velocity: ")
    talk.calls("mode drone1 land")
    fake.answer(fake.receive("put"))
    assert talk.returned() == "1"


def test_every_put_is_one_line_of_json(talk: Talk, fake: FakeGateway) -> None:
    connected(talk, fake)
    talk.calls('fields my/"key" -0 \\"\x01ä')
    put = fake.receive("put")
    assert put["key"] == 'my/"key"'
    assert put["value"] == {"number": 0, "text": '\\"\x01ä', "integer": -(2**63), "json": {"a": [1, 2]}}
    fake.answer(put)
    assert talk.returned() == "1"
    assert has_terms(talk.does("put my/key {1:2}"), "-1 my/key: ", "JSON")
    assert parts(talk.does("fields my/key inf text")) == ("number", "not finite")


def test_requests_are_answered(talk: Talk, fake: FakeGateway) -> None:
    connected(talk, fake)
    talk.calls('ask world/control acquire {"drone":"drone1"}')
    asked = fake.receive("ask")
    assert (asked["key"], asked["request"], asked["args"]) == ("world/control", "acquire", {"drone": "drone1"})
    fake.send({"op": "answer", "ok": True, "error": None, "result": 5, "id": asked["id"]})
    assert talk.returned() == "1 5"
    talk.calls("ask world/control pause")
    fake.send({"op": "answer", "ok": False, "error": "is paused", "result": None, "id": fake.receive("ask")["id"]})
    assert talk.returned() == "-1 world/control pause: is paused"
    assert has_terms(talk.does("ask world/control pause {"), "-1 zsim_ask: args ", "JSON")


def joined(talk: Talk, fake: FakeGateway) -> None:
    connected(talk, fake)
    in_session(talk, fake)


def in_session(talk: Talk, fake: FakeGateway) -> None:
    talk.calls("join square 0.02 drone/*/estimate,clock")
    join = fake.receive("join")
    assert (join["name"], join["period_s"], join["reads"]) == ("square", 0.02, ["drone/*/estimate", "clock"])
    fake.answer(join, name="client.square", gates=[])
    assert talk.returned() == "1"


def test_a_gate_delivers_inputs_and_sends_outputs(talk: Talk, fake: FakeGateway) -> None:
    joined(talk, fake)
    assert talk.does("gate 0") == "0"
    assert talk.does("done").startswith("-1 zsim_done: ")
    fake.send(ESTIMATE)
    assert talk.does("gate 60") == "1"
    assert talk.does("input drone/drone1/estimate position_m") == "1 [1, 2, 3]"  # the newest
    assert talk.does("input drone/drone2/estimate position_m") == "1 "
    assert has_terms(talk.does("gate 0"), "-1 zsim_gate: ", "0.020 s")
    talk.calls("latest clock t_ns")
    fake.answer(fake.receive("latest"), values=[{"key": "clock", "value": {"t_ns": 7}}])
    assert talk.returned() == "1 7"
    assert talk.does("input drone/drone1/estimate sensors.gps.0") == "1 1"  # the inputs are kept until the gate is done
    assert talk.does("velocity drone1 1 0 0 0 world") == "1"
    assert talk.does("velocity drone1 1 0 inf 0 world").startswith("-1 ")  # not among the outputs
    assert talk.does("put my/key [1]") == "1"
    assert talk.does("done") == "1"
    done = fake.receive("done")
    flown = {"velocity_m_s": [1, 0, 0], "yaw_rate_rad_s": 0, "frame": "world"}
    assert done["t_ns"] == 20_000_000
    assert done["outputs"] == [{"key": "drone/drone1/cmd/velocity", "value": flown}, {"key": "my/key", "value": [1]}]


def test_a_refused_done_leaves_the_gate_open(talk: Talk, fake: FakeGateway) -> None:
    joined(talk, fake)
    fake.send(ESTIMATE)
    assert [talk.does("gate 60"), talk.does("mode drone1 fly"), talk.does("done")] == ["1", "1", "1"]
    fake.send({"op": "error", "error": "mode is fly", "id": fake.receive("done")["id"]})
    assert talk.does("gate 60") == "-1 mode is fly"
    assert [talk.does("mode drone1 land"), talk.does("done")] == ["1", "1"]
    assert fake.receive("done")["outputs"] == [{"key": "drone/drone1/cmd/mode", "value": {"mode": "land"}}]


def test_an_unfinished_put_is_never_sent(talk: Talk, fake: FakeGateway) -> None:
    joined(talk, fake)
    assert talk.does("end").startswith("-1 zsim_put_end: ")
    assert [talk.does("begin my/lost"), talk.does("add a b")] == ["1", "1"]
    talk.calls("latest clock t_ns")
    fake.answer(fake.receive("latest"), values=[])
    assert talk.returned() == "0"
    assert talk.does("end").startswith("-1 zsim_put_end: ")
    assert talk.does("begin my/lost") == "1"
    fake.send(ESTIMATE)
    assert [talk.does("gate 60"), talk.does("add a b")] == ["1", "1"]
    assert talk.does("end").startswith("-1 zsim_put_end: ")
    assert [talk.does("begin my/lost"), talk.does("add a b"), talk.does("begin my/key")] == ["1", "1", "1"]
    assert has_terms(talk.does("done"), "-1 zsim_done: my/key ", "zsim_put_end")
    assert [talk.does("add a b"), talk.does("end"), talk.does("done")] == ["1", "1", "1"]
    assert fake.receive("done")["outputs"] == [{"key": "my/key", "value": {"a": "b"}}]


def test_a_session_keeps_nothing_of_the_previous_one(talk: Talk, fake: FakeGateway) -> None:
    joined(talk, fake)
    assert has_terms(talk.does("join other 0.02 clock"), "-1 zsim_join: ", "client.square", "zsim_leave")
    fake.send(ESTIMATE)
    assert [talk.does("gate 60"), talk.does("done")] == ["1", "1"]
    fake.send({"op": "left", "reason": "the run ended"})
    fake.send({"op": "error", "error": "done: has not joined", "id": fake.receive("done")["id"]})
    assert talk.does("gate 60").endswith(": the run ended")
    in_session(talk, fake)
    fake.send(ESTIMATE)  # still in transit when the client leaves
    talk.calls("leave")
    fake.answer(fake.receive("leave"))
    assert talk.returned() == "1"
    in_session(talk, fake)
    fake.send({"op": "gate", "t_ns": 40_000_000, "inputs": []})
    assert [talk.does("gate 60"), talk.does("done")] == ["1", "1"]
    assert fake.receive("done")["t_ns"] == 40_000_000


def test_a_lost_session_and_the_end_of_a_run_are_reported(talk: Talk, fake: FakeGateway) -> None:
    joined(talk, fake)
    fake.send({"op": "left", "reason": "the run ended"}, {"op": "run", "state": "ended", "run_id": "r1"})
    assert talk.does("gate 60").endswith(": the run ended")
    assert talk.does("gate 60").startswith("-1 zsim: ")
    assert has_terms(talk.does("next 60"), "-1 zsim: ", "ended")
    fake.send({"op": "run", "state": "begun", "run_id": "r2"}, {"op": "value", "key": "a", "value": 1})
    assert talk.does("next 60") == "1 a 1 lost 0"
    talk.calls("hello")
    fake.send({**HELLO, "run_id": "r2", "id": fake.receive("hello")["id"]})
    assert talk.returned() == "1"


@pytest.mark.parametrize("rubbish", [b"no json\n", b"\xff\x00\n", b"[" * 900 + b"\n", b'{"op": "value"\n', b"\n"])
def test_invalid_json_closes_the_connection(talk: Talk, fake: FakeGateway, rubbish: bytes) -> None:
    connected(talk, fake)
    fake.send(rubbish)
    assert has_terms(talk.does("next 60"), "-1 zsim: ", "JSON")
    assert has_terms(talk.does("next 60"), "-1 zsim: ", "connection")


def test_the_rest_of_an_incomplete_line_is_awaited(talk: Talk, fake: FakeGateway) -> None:
    connected(talk, fake)
    fake.send(b'{"op": "value", "key": "a", "va')
    assert talk.does("next 0.05") == "0"
    fake.send(b'lue": 1}\n{"op"')
    assert talk.does("next 60") == "1 a 1 lost 0"
    fake.disconnect()
    assert has_terms(talk.does("next 60"), "-1 zsim: ", "connect again")


def test_the_oldest_of_too_many_values_are_dropped(build: Build, fake: FakeGateway) -> None:
    talk = Talk(build("clients/c/tests/talk.c", *SANITIZED, *SMALL))
    connected(talk, fake)
    talk.calls("latest clock t_ns")
    asked = fake.receive("latest")
    fake.send(*({"op": "value", "key": "a", "value": f"{n:030}"} for n in range(100)))
    fake.send({"op": "lost", "lines": 5})
    fake.answer(asked, values=[])
    assert talk.returned() == "0"
    kept = [talk.does("next 0") for _ in range(12)]
    numbers = [int(each.split('"')[1]) for each in kept]
    assert numbers == list(range(numbers[0], numbers[0] + 12))  # the newest, in order, without a gap
    lost = int(kept[0].split()[-1])
    assert lost == numbers[0] + 5
    fake.send(b'{"op": "value", "key": "' + b"a" * 2000)
    last = ""
    while last == "" or last.startswith("1 a"):
        last = talk.does("next 60")
    assert has_terms(last, "-1 zsim: ", "ZSIM_LINE_MAX")
    talk.ends()


@pytest.mark.parametrize("seed", range(8))
def test_corrupted_lines_do_no_harm(talk: Talk, fake: FakeGateway, seed: int) -> None:
    """Every call returns after randomly corrupted lines, and the sanitizers find no invalid access."""
    rng = random.Random(seed)
    joined(talk, fake)
    printed = [
        ESTIMATE,
        HELLO,
        {"op": "latest", "values": [{"key": "a", "value": 1}], "id": 5},
        {"op": "left", "reason": "x"},
    ]
    for _ in range(30):
        line = bytearray(json.dumps(rng.choice(printed)).encode())
        for _ in range(rng.randrange(3)):
            line[rng.randrange(len(line))] = rng.choice(b'{}[]",:0123456789.eE+-\\u \xff\x00\n')
        fake.send(bytes(line) + b"\n")
    fake.send(b'{"op": "answer", "id": ')
    calls = ("gate 0", "next 0", "done", "input drone/drone1/estimate position_m", "velocity drone1 1 0 0 0")
    assert all(re.match(r"-1 \S|[01]", talk.does(rng.choice(calls))) for _ in range(60))


@pytest.mark.parametrize("name", LOCALES, ids=LOCALES.get)
def test_commands_are_independent_of_the_locale(
    build: Build, fake: FakeGateway, locales: dict[str, str], name: str
) -> None:
    talk = Talk(build("clients/c/tests/talk.c", *SANITIZED), f"{name}.UTF-8", env=locales)
    point = {"de_DE": ",", "ps_AF": "\u066b"}[name]
    talk.calls(f"connect {fake.port} 60 me")
    fake.welcome()
    assert talk.returned() == f"1 client.me r1 lockstep 0{point}02 1200000000"
    assert talk.does(f"velocity drone1 0{point}1 0{point}2 -0{point}3 0") == "1"
    assert fake.receive("put")["value"]["velocity_m_s"] == [0.1, 0.2, -0.3]
    talk.ends()


# Flights


def flown(federation: Federation, program: Path, *options: str, stop: bool = False) -> tuple[list[list[float]], str]:
    """Fly the square through a gateway; return t [s] and position [m; W] at its corners, and the hash of the truth."""
    world = federation.world(SQUARE, *options)
    federation.role("estimator", "drone1")
    client = federation.client()
    events = client.subscribe("world/event")
    gateway = GatewayProcess(federation)
    printed = output(program, "127.0.0.1", gateway.lines_port)
    if stop:
        client.request("world/control", "stop")
    corners = [
        [float(n) for n in re.findall(r"-?\d+\.\d+", line)[:4]] for line in printed.splitlines() if "corner" in line
    ]
    assert re.search(r"landed at t = \d+\.\d\d s\n$", printed), printed
    assert len(corners) == 5, printed
    end = events.until(lambda m: m["kind"] == "end").message["data"]
    world.ends(with_code=0)
    return corners, end["truth_sha256"]


def is_a_square(corners: list[list[float]]) -> None:
    start = [corners[0][1], corners[0][2]]
    offsets = [[x - start[0], y - start[1]] for _, x, y, _ in corners]
    for offset, wanted in zip(offsets, [(0, 0), (2, 0), (2, 2), (0, 2), (0, 0)], strict=True):
        assert offset == pytest.approx(wanted, abs=0.6)  # from one corner to another, each reached within 0.25 m
    assert all(z == pytest.approx(1.5, abs=0.3) for *_, z in corners)


def test_fast_and_slow_builds_fly_bit_identical_squares_in_lockstep(
    build: Build, tmp_path: Path, compiled: None
) -> None:
    """Time waits for the client, so that its speed does not affect the flight."""
    flights = []
    for name, flags in (("fast", ("-O2",)), ("slow", SANITIZED)):
        (tmp_path / name).mkdir()
        with Federation(tmp_path / name) as federation:
            flights.append(flown(federation, build("examples/c/square.c", *flags), "--duration", "22"))
    is_a_square(flights[0][0])
    assert flights[0] == flights[1]


@pytest.mark.soak
def test_the_client_flies_a_square_in_realtime(build: Build, federation: Federation) -> None:
    program = build("examples/c/square.c", *SANITIZED)
    corners, _ = flown(federation, program, "--realtime", "--rate", "3", "--duration", "60", stop=True)
    is_a_square(corners)


def test_the_calls_work_with_a_real_gateway(talk: Talk, federation: Federation) -> None:
    federation.world(ONE, "--rate", "4", "--duration", "600")
    gateway = GatewayProcess(federation, "--token", "secret")
    assert has_terms(talk.does(f"connect {gateway.lines_port} 60 me wrong"), "-1 hello: ", "token")
    assert re.match(r"1 client\.me \w+ lockstep 0\.02 \d+", talk.does(f"connect {gateway.lines_port} 60 me secret"))
    assert talk.does("subscribe drone/*/sensor/status") == "1"
    assert re.match(r'1 drone/drone1/sensor/status \{.*"state":"landed".* lost 0', talk.does("next 60"))
    assert talk.does("unsubscribe drone/*/sensor/status") == "1"
    assert talk.does("mode drone1 takeof").startswith("-1 drone/drone1/cmd/mode: ")
    assert talk.does("mode drone1 takeoff") == "1"
    assert talk.does("velocity drone1 1 0 0 0 inertial") == "1"
    assert "inertial" in talk.does(
        "latest clock state"
    )  # the refusal of the velocity, which did not wait for an answer
    assert talk.does("latest clock state") == '1 "running"'
    assert talk.does('ask world/control acquire {"drone":"drone1","priority":3}').startswith("1")
    assert re.match(r"-1 world/control dance: .*dance", talk.does("ask world/control dance"))
    assert talk.does("join me 0.02 clock") == "1"
    for _ in range(3):
        assert [talk.does("gate 60"), talk.does("velocity drone1 0 0 0 0"), talk.does("done")] == ["1", "1", "1"]
    assert talk.does("leave") == "1"
    assert talk.does("close") == "1"


def test_the_first_program_of_the_docs_runs(build: Build, federation: Federation, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "clients-c.md").read_text()
    program = tmp_path / "first.c"
    lines = re.findall(r"^    (#include \"zsim.h\"\n(?:(?:    .*)?\n)*?    })\n\n", page, flags=re.MULTILINE)
    federation.world(ONE, "--duration", "600", "--rate", "4")
    gateway = GatewayProcess(federation)
    program.write_text(textwrap.dedent(f"    {lines[0]}\n").replace("ZSIM_PORT", str(gateway.lines_port)))
    assert output(build(str(program))) == "it hovers\n"
