"""The gateway under fuzzing: no 5xx, no crash, no effect of refused requests."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from federation import Federation
from gateway_process import GatewayProcess, LineConnection
from hypothesis import given, settings
from hypothesis import strategies as st
from test_gateway import FLOWN, fly

SCHEMATHESIS = Path(sys.executable).with_name("st")
HANGS_S = 900.0  # wall time after which the fuzzer counts as hung
EXAMPLES = 2  # per operation
SEED = "2"  # generates no `*` as a name: it is an expression, which the patterns exclude and a list answers
CHECKS = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance"
STRICT = f"{CHECKS},negative_data_rejection,positive_data_acceptance,unsupported_method"
GATES_FUZZED = 180  # out of the flight's 201 gates; the run ends during the last ones
OWN_KEYS = r"\{key\}"  # paths of user keys, where a key outside the pattern may be valid, too


def fuzz(gateway: GatewayProcess, checks: str, mode: str, *options: str, examples: int = EXAMPLES) -> str:
    """Run schemathesis on a gateway's description; return its output, and fail if it finds anything."""
    command = [
        SCHEMATHESIS, "run", f"{gateway.url}/openapi.json", "--checks", checks, "--mode", mode, "--seed", SEED,
        "--max-examples", str(examples), "--phases", "examples,coverage,fuzzing", "--warnings", "off", "--no-color",
        "--generation-database", "none", *options,
    ]  # fmt: skip
    environment = {**os.environ, "SCHEMATHESIS_HOOKS": ""}
    done = subprocess.run(command, capture_output=True, text=True, cwd=gateway.folder, env=environment, timeout=HANGS_S)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    return done.stdout


@pytest.mark.soak
@pytest.mark.parametrize(
    ("checks", "option"),
    [(STRICT, "--exclude-path-regex"), (CHECKS, "--include-path-regex")],
    ids=["what zsim answers", "own keys"],
)
def test_the_gateway_conforms_to_its_openapi_description(federation: Federation, checks: str, option: str) -> None:
    federation.world(FLOWN.replace("duration_s: 4", "duration_s: 3600"), "--expect", "nobody.yet")
    gateway = GatewayProcess(federation).in_run()
    fuzz(gateway, checks, "all", option, OWN_KEYS)
    assert gateway.http("GET", "/json/clock").status == 200


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda part: st.lists(part, max_size=4) | st.dictionaries(st.text(max_size=8), part, max_size=4),
    max_leaves=8,
)
FIELDS = st.sampled_from(["t_ns", "seq", "source", "velocity_m_s", "yaw_rate_rad_s", "frame", "mode", "position_m"])
BODIES = st.binary(max_size=60) | (JUNK | st.dictionaries(FIELDS, JUNK, max_size=6)).map(
    lambda value: json.dumps(value).encode()
)
COMMANDS = st.sampled_from(["velocity", "mode", "ardrone", "attitude", "rotors"])


WAYS = ("json", "zenoh", "stream", "control", "headers")


class Refused(NamedTuple):
    """An invalid request: the entry that it uses, a kind of command and a body."""

    way: str
    kind: str
    body: bytes


def junk(count: int) -> list[Refused]:
    """Return requests that hypothesis generates deterministically."""
    made: list[Refused] = []

    @settings(max_examples=count, deadline=None, derandomize=True, database=None)
    @given(st.sampled_from(WAYS), COMMANDS, BODIES)
    def think(way: str, kind: str, body: bytes) -> None:
        made.append(Refused(way, kind, body))

    think()
    return made


def test_refused_requests_do_not_change_the_flight(tmp_path):
    hashes = [_flown(tmp_path / "alone", []), _flown(tmp_path / "fuzzed", junk(GATES_FUZZED))]
    assert hashes[0] == hashes[1]


def _flown(folder: Path, requests: list[Refused]) -> str:
    """Return the hash of the truth of a flight with a refused request at each gate."""
    folder.mkdir()
    left = iter(requests)
    with Federation(folder) as federation:
        world = federation.world(FLOWN, "--expect", "recorder")
        recorder = federation.role("record", "--out", str(federation.out))
        gateway = GatewayProcess(federation).in_run()
        with gateway.connect() as stream:
            stream.request("hello")
            fly(gateway, lambda: _refused(gateway, stream, next(left, None)))
        world.ends(with_code=0)
        recorder.ends(with_code=0)
        assert next(left, None) is None
        assert "failed" not in gateway.role.text()
        return federation.record().sha256()


def _refused(gateway: GatewayProcess, stream: LineConnection, request: Refused | None) -> None:
    """Send a request, if any, and check that it is refused."""
    if request is None:
        return
    way, kind, body = request
    if way == "stream":
        value = body if b"\n" not in body and body else b"{"
        stream.send_line(b'{"op": "put", "key": "drone/drone1/cmd/%b", "value": %b}' % (kind.encode(), value))
        stream.next("error")
        return
    headers = {"Content-Type": body[:20].hex() + "\xff"} if way == "headers" else {}
    path = {"json": f"/json/drone/drone1/cmd/{kind}", "control": "/json/world/control"}.get(way)
    method = "POST" if way == "control" else "PUT"
    answer = gateway.http(method, path or f"/zsim/drone/drone1/cmd/{kind}", body, headers)
    assert answer.status == 400, (answer, request)
