"""examples/plain_client.py: a page of code by docs/protocol.md takes part as ours do."""

import ast
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest
from federation import ONE, Federation
from forked_commands import ROOT
from wire import PATIENCE_S

PROGRAM = ROOT / "examples" / "plain_client.py"
NAME = "plain.client"


@pytest.fixture
def plain_client(federation: Federation) -> Iterator["subprocess.Popen[str]"]:
    """The program, run against the federation's endpoint as its user would."""
    command = [sys.executable, str(PROGRAM), federation.endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        yield process
        process.kill()


def test_it_is_a_page_of_zenoh_and_msgpack() -> None:
    text = PROGRAM.read_text()
    assert len(text.splitlines()) <= 40
    imported = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {alias.name for node in imported if isinstance(node, ast.Import) for alias in node.names}
    assert names <= {"os", "sys", "zenoh", "msgpack"}
    assert not [node for node in imported if isinstance(node, ast.ImportFrom)]
    puts = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    puts = [node for node in puts if ast.unparse(node.func) == "session.put"]
    assert puts
    for put in puts:  # without it zenoh drops what does not fit, and the world waits for ever
        assert "congestion_control=zenoh.CongestionControl.BLOCK" in ast.unparse(put)


def test_it_flies_and_holds_time(federation: Federation, request: pytest.FixtureRequest) -> None:
    world = federation.world(ONE, "--rate", "0.25", "--duration", "11", "--set", "processes.expect=[]")
    client = federation.client()
    clock, events = client.subscribe("clock"), client.subscribe("world/event")
    truth = client.subscribe("drone/drone1/truth")
    clock.until(lambda m: m["t_ns"] > 0)  # nobody is expected: time runs
    program: subprocess.Popen[str] = request.getfixturevalue("plain_client")
    joined = events.until(lambda m: (m["kind"], m["subject"]) == ("join", NAME))
    assert joined.message["data"]["from_ns"] > 0
    assert client.request("world/control", "rate", value=4)["ok"]
    commander = events.until(lambda m: m["kind"] == "commander")
    assert commander.message["source"] == NAME

    os.kill(program.pid, signal.SIGSTOP)
    first, later = (clock.until(lambda m: NAME in [w["name"] for w in m["waiting_for"]]) for _ in range(2))
    assert first.message["t_ns"] == later.message["t_ns"]
    (entry,) = later.message["waiting_for"]
    assert entry["host"] == "here"
    assert entry["since_wall_s"] > first.message["waiting_for"][0]["since_wall_s"]
    os.kill(program.pid, signal.SIGCONT)

    output, _ = program.communicate(timeout=PATIENCE_S)
    assert program.returncode == 0, output
    assert re.fullmatch(r"t = 10\.0\d s, flying, accelerometer \[.*\]\n", output)
    flown = truth.until(lambda m: m["t_ns"] >= 10 * 10**9)  # the run may be over by now
    east, north, _ = flown.message["velocity_m_s"]
    assert north == pytest.approx(0.5, abs=0.3)  # m/s forward, the drone looks north
    assert east == pytest.approx(0.0, abs=0.3)
    assert events.until(lambda m: m["kind"] == "leave").message["data"]["reason"] == "shown"
    world.ends(with_code=0)
