"""examples/plain_client.py and foreign_estimator.py, written from docs/protocol.md, take part in runs."""

import ast
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from federation import ONE, Federation
from forked_commands import ROOT
from refused import has_terms
from wire import PATIENCE_S, Subscription

PROGRAM = ROOT / "examples" / "plain_client.py"
ESTIMATOR = ROOT / "examples" / "foreign_estimator.py"
NAME = "plain.client"


@pytest.fixture
def plain_client(federation: Federation) -> Iterator["subprocess.Popen[str]"]:
    """The program, run against the federation's endpoint as its user would."""
    command = [sys.executable, str(PROGRAM), federation.endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        yield process
        process.kill()


def test_the_client_is_one_page_with_only_zenoh_and_msgpack() -> None:
    text = PROGRAM.read_text()
    assert len(text.splitlines()) <= 40
    imported = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {alias.name for node in imported if isinstance(node, ast.Import) for alias in node.names}
    assert names <= {"os", "queue", "sys", "zenoh", "msgpack"}
    assert not [node for node in imported if isinstance(node, ast.ImportFrom)]
    puts = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    puts = [node for node in puts if ast.unparse(node.func) == "session.put"]
    assert puts
    for put in puts:  # or Zenoh drops what does not fit, and the world waits forever
        assert "congestion_control=zenoh.CongestionControl.BLOCK" in ast.unparse(put)


def standing(clock: Subscription) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return two `waiting_for` entries of the program at one instant, once all that it sent has been used."""
    former = None
    while True:
        now = clock.until(lambda m: [w["name"] for w in m["waiting_for"]] == [NAME]).message
        if former is not None and former["t_ns"] == now["t_ns"]:
            return former["waiting_for"][0], now["waiting_for"][0]
        former = now


def test_the_client_flies_and_holds_time(federation: Federation, request: pytest.FixtureRequest) -> None:
    world = federation.world(ONE, "--rate", "0.25", "--duration", "3600", "--set", "processes.expect=[]")
    client = federation.client()
    clock, events = client.subscribe("clock"), client.subscribe("world/event")
    truth = client.subscribe("drone/drone1/truth")
    clock.until(lambda m: m["t_ns"] > 0)  # no process is expected, so time runs
    program: subprocess.Popen[str] = request.getfixturevalue("plain_client")
    joined = events.until(lambda m: (m["kind"], m["subject"]) == ("join", NAME))
    assert joined.message["data"]["from_ns"] > 0
    assert client.request("world/control", "rate", value=4)["ok"]
    commander = events.until(lambda m: m["kind"] == "commander")
    assert commander.message["source"] == NAME

    os.kill(program.pid, signal.SIGSTOP)
    first, later = standing(clock)
    assert later["host"] == "here"
    assert later["since_wall_s"] > first["since_wall_s"]
    os.kill(program.pid, signal.SIGCONT)

    output, _ = program.communicate(timeout=PATIENCE_S)
    assert program.returncode == 0, output
    shown = re.fullmatch(r"t = (\d+\.\d\d) s, flying, accelerometer \[.*\]\n", output)
    assert shown is not None, output
    assert float(shown[1]) >= 10.0
    flown = truth.until(lambda m: m["t_ns"] >= 10 * 10**9)  # the run may have ended by now
    east, north, _ = flown.message["velocity_m_s"]
    assert north == pytest.approx(0.5, abs=0.3)  # m/s forward; the drone faces north
    assert east == pytest.approx(0.0, abs=0.3)
    assert events.until(lambda m: m["kind"] == "leave").message["data"]["reason"] == "shown"
    assert client.request("world/control", "stop")["ok"]
    world.ends(with_code=0)


def test_the_client_joins_a_running_world_and_flies_ten_seconds(
    federation: Federation, request: pytest.FixtureRequest
) -> None:
    world = federation.world(ONE, "--rate", "10", "--duration", "36000")
    client = federation.client()
    begun = client.subscribe("clock").until(lambda m: m["t_ns"] > 15e9).message["t_ns"]
    program: subprocess.Popen[str] = request.getfixturevalue("plain_client")
    output, _ = program.communicate(timeout=PATIENCE_S)
    assert program.returncode == 0, output
    shown = re.fullmatch(r"t = (\d+\.\d\d) s, flying, accelerometer \[.*\]\n", output)
    assert shown is not None, output
    assert float(shown[1]) >= begun / 1e9 + 10.0
    assert client.request("world/control", "stop")["ok"]
    world.ends(with_code=0)


@pytest.mark.parametrize(("program", "name"), [(PROGRAM, NAME), (ESTIMATOR, "foreign.drone1")])
def test_a_killed_world_ends_the_program_with_one_line(program: Path, name: str, federation: Federation) -> None:
    """The world is killed while the program answers its gates."""
    world = federation.world(ONE.replace("expect: []", f"expect: [{name}]"), "--rate", "1", "--duration", "3600")
    clock = federation.client().subscribe("clock")
    clock.until(lambda _: True)
    command = [sys.executable, str(program), federation.endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        clock.until(lambda m: m["t_ns"] > 0)  # the program has answered a gate
        world.signal(signal.SIGKILL)
        output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1, output
    assert has_terms(output.splitlines()[-1], "world", "silent")
    assert "Traceback" not in output
