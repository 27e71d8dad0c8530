"""The command line: inspection and publishing as users of `ros2 topic` expect, requests, and help."""

import json
import re
import time
from pathlib import Path

import pytest
from federation import ONE, PAIR, Federation
from forked_commands import Completed, refusal, run_here
from refused import has_terms
from wire import PATIENCE_S

from zsim_analysis.report.figure_style import ReportFigure

COMMANDS = (
    *("run", "validate", "report", "sweep", "world", "estimator", "controller", "host", "record"),
    *("keys", "echo", "hz", "pub", "ask"),
)
LISTED = {"clock": "Clock", "drone/drone1/sensor/imu": "Imu", "cluster/main/state": "ClusterState"}


def zsim(*arguments: str, code: int = 0) -> Completed:
    """Run a command, which must exit with the given code."""
    done = run_here(*arguments)
    assert done.code == code, done
    return done


class Terminal:
    """Commands against a running federation."""

    def __init__(self, federation: Federation) -> None:
        self.reach = ("--connect", federation.endpoint)

    def __call__(self, *arguments: str, code: int = 0) -> str:
        done = zsim(*arguments, *self.reach, code=code)
        return done.stdout if code == 0 else done.stderr


def test_a_run_can_be_inspected_and_its_controller_commanded(federation: Federation) -> None:
    run = federation.run(PAIR, "--rate", "2", "--duration", "1000")
    client = federation.client()
    client.subscribe("clock").until(lambda m: m["t_ns"] > 5.5e9)
    terminal = Terminal(federation)
    until_s, listed = time.monotonic() + PATIENCE_S, ""
    while not all(re.search(rf"^{key} +{message} +\d+$", listed, re.MULTILINE) for key, message in LISTED.items()):
        assert time.monotonic() < until_s, listed
        listed = terminal("keys")  # covers one second, in which a loaded machine may publish no message
    echoed = [json.loads(line) for line in terminal("echo", "drone/*/truth", "-n", "4").splitlines()]
    assert {line["key"] for line in echoed} == {"drone/drone1/truth", "drone/drone2/truth"}
    assert all(len(line["message"]["position_m"]) == 3 for line in echoed)
    (raw,) = terminal("echo", "clock", "-n", "1", "--raw").splitlines()
    assert bytes.fromhex(json.loads(raw)["message"]).startswith(b"\x87")  # a msgpack map of seven fields
    assert "50.0 Hz" in terminal(
        "hz", "drone/drone1/truth", "--seconds", "2.5"
    )  # not the clock, which repeats while it waits
    assert "nothing/here" in terminal("hz", "nothing/here", "--seconds", "0.1", code=1)

    state = client.subscribe("cluster/main/state")
    state.until(lambda m: m["phase"] == "engaged")
    assert terminal("ask", "cluster/main/control", "hold") == "ok\n"
    state.until(lambda m: m["phase"] == "held")
    assert terminal("ask", "cluster/main/control", "engage") == "ok\n"
    before = state.until(lambda m: m["phase"] == "engaged").message
    target = {"values": {"z_c": 2.5}, "over_s": 4}
    assert terminal("ask", "cluster/main/control", "target", json.dumps(target)) == "ok\n"
    place = before["names"].index("z_c")
    state.until(lambda m: m["desired"][place] == pytest.approx(2.5))
    assert "nothing" in terminal("ask", "cluster/main/control", "target", '{"values": {"nothing": 1}}', code=1)
    assert terminal("ask", "cluster/main/control", "land") == "ok\n"
    state.until(lambda m: m["phase"] == "idle")
    assert terminal("ask", "world/control", "stop") == "ok\n"
    run.ends(with_code=0)


BAD_COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "no json": (("pub", "drone/drone1/cmd/mode", "{mode"), ("JSON",)),
    "no map": (("pub", "drone/drone1/cmd/mode", "[1]"), ("map",)),
    "no such mode": (("pub", "drone/drone1/cmd/mode", '{"mode": "x"}'), ("mode is 'x'", "takeoff")),
    "unknown key": (("pub", "drone/drone1/fly", "{}"), ("drone/drone1/fly",)),
    "args no json": (("ask", "world/control", "step", "{x"), ("args", "JSON")),
    "args no map": (("ask", "world/control", "step", "3"), ("map",)),
    "nobody answers": (("ask", "cluster/nobody/control", "land"), ("cluster/nobody/control",)),
    "ask of several": (("ask", "world/*", "pause"), ("'world/*'", "wildcards")),
    "ask as in ros2": (("ask", "/world/control", "pause"), ("'/world/control'", "must be world/control")),
    "ask of no key": (("ask", "world//control", "pause"), ("key is 'world//control'",)),
    "a huge argument": (("ask", "world/control", "step", f'{{"gates": {10**22}}}'), ("args",)),
    "echo as in ros2": (("echo", "/clock"), ("'/clock'", "must be clock")),
    "echo of nothing": (("echo", ""), ("key is ''",)),
    "echo of no key": (("echo", "drone/#$?/x"), ("key is 'drone/#$?/x'",)),
    "hz of no key": (("hz", "drone//x"), ("'drone//x'", "must be drone/x")),
    "pub to a ghost": (("pub", "drone/ghost/cmd/mode", '{"mode": "land"}'), ("'ghost'", "drone1")),
    "pub to all": (("pub", "drone/*/cmd/mode", '{"mode": "land"}'), ("'drone/*/cmd/mode'", "wildcards")),
    "pub for the world": (("pub", "clock", "{}"), ("clock: ",)),
}
REFUSED: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "no op": (("ask", "world/control", "jump"), ("op is 'jump'", "pause")),
    "a word of ours": (("ask", "world/control", "rate", '{"source": "me"}'), ("value is None", "0")),
    "a fault of a ghost": (("fault", "add", "ghost", "gps_dropout"), ("'ghost'", "drone1")),
    "no such fault": (("fault", "clear", "7"), ("7",)),
    "a command of a drone on the ground": (
        ("pub", "drone/drone1/cmd/velocity", '{"velocity_m_s": [1, 0, 0], "yaw_rate_rad_s": 0}'),
        ("refused 1 of 1", "drone1 is landed"),
    ),
}


def test_the_world_answers_requests_and_bad_commands_are_refused(federation: Federation) -> None:
    world = federation.world(ONE, "--rate", "4", "--duration", "1000")
    client = federation.client()
    clock = client.subscribe("clock")
    clock.until(lambda m: m["t_ns"] > 0)
    terminal = Terminal(federation)
    for name, (arguments, tokens) in BAD_COMMANDS.items():
        line = refusal(*arguments, *terminal.reach)
        assert has_terms(line, *tokens), (name, line)
    for name, (arguments, tokens) in REFUSED.items():
        assert has_terms(terminal(*arguments, code=1).splitlines()[-1], *tokens), name
    assert terminal("ask", "world/control", "pause") == "ok\n"
    paused = clock.until(lambda m: m["state"] == "paused").message["t_ns"]
    assert terminal("ask", "world/control", "step", '{"gates": 5}') == "ok\n"
    clock.until(lambda m: m["state"] == "paused" and m["t_ns"] == paused + 100_000_000)
    assert terminal("ask", "world/control", "resume") == "ok\n"
    clock.until(lambda m: m["state"] == "running")
    assert terminal("ask", "world/control", "rate", '{"value": 20}') == "ok\n"
    clock.until(lambda m: m["rate"] > 15)
    assert re.search(r"\b1\b", terminal("pub", "drone/drone1/cmd/mode", '{"mode": "takeoff"}'))
    states = client.subscribe("drone/drone1/sensor/status")
    states.until(lambda m: m["state"] == "hovering")
    velocity = '{"velocity_m_s": [0, 0, 0.5], "yaw_rate_rad_s": 0}'
    assert re.search(r"\b3\b", terminal("pub", "drone/drone1/cmd/velocity", velocity, "-n", "3", "--rate-hz", "100"))
    assert states.until(lambda m: m["state"] == "flying").message["commander"] == "zsim.pub"
    assert terminal("ask", "world/control", "stop", '{"reason": "enough"}') == "ok\n"
    world.line("stopped by zsim.ask: enough")
    world.ends(with_code=0)


def test_every_command_has_help() -> None:
    text = zsim("--help").stdout
    for command in COMMANDS:
        assert re.search(rf"\b{command}\b", text)
        own = zsim(command, "--help").stdout
        assert f"zsim {command}" in own
        assert "--launched" not in own
    assert zsim("--version").stdout.startswith("zsim 0.")


def test_validate_prints_the_resolved_scenario(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(ONE)
    resolved = zsim("validate", str(path), "--set", "seed=77").stdout
    assert "seed: 77" in resolved
    path.write_text(resolved)
    again = zsim("validate", str(path))
    assert again.stdout == resolved
    assert again.stderr.splitlines() == ["one.yaml: no errors found"]


def test_a_report_is_written_from_a_record(federation: Federation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ReportFigure, "png", lambda _: b"\x89PNG")  # the tests of reports draw figures
    zsim("run", federation.write(PAIR), "--in-process", "--duration", "2", "--no-report", "--out", str(federation.out))
    output = zsim("report", str(federation.out)).stdout
    assert f"report: {federation.out / 'report.html'}" in output
    summary = json.loads((federation.out / "summary.json").read_text())
    assert summary["truth_sha256"] == federation.record().sha256()
    assert summary["seed"] == 3
    assert (federation.out / "report.html").stat().st_size > 1000
