"""The command line: looking and poking as `ros2 topic` users expect, and help that reads well."""

import json
import re
import subprocess
from pathlib import Path

import pytest
from federation import ONE, PAIR, ROOT, ZSIM, Federation, Role
from wire import PATIENCE_S

COMMANDS = (
    "run",
    "validate",
    "report",
    "sweep",
    "world",
    "estimator",
    "controller",
    "host",
    "record",
    "keys",
    "echo",
    "hz",
    "pub",
    "ask",
)


def zsim(*arguments: str, code: int = 0) -> "subprocess.CompletedProcess[str]":
    """Run a command to its end."""
    done = subprocess.run(
        [*ZSIM, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == code, done.stderr
    return done


class Terminal:
    """Commands against a running federation."""

    def __init__(self, federation: Federation) -> None:
        self.reach = ("--connect", federation.endpoint)

    def __call__(self, *arguments: str, code: int = 0) -> str:
        done = zsim(*arguments, *self.reach, code=code)
        return done.stdout if code == 0 else done.stderr


@pytest.fixture
def flying(federation: Federation) -> Role:
    """PAIR at real time for as long as the test takes."""
    run = federation.run(PAIR, "--rate", "3", "--duration", "1000")
    federation.client().watch("clock").until(lambda m: m["t_ns"] > 5.5e9)
    return run


def test_looking_at_a_run(federation: Federation, flying: Role) -> None:
    terminal = Terminal(federation)
    keys = terminal("keys")
    for key, message in (
        ("clock", "Clock"),
        ("drone/drone1/sensor/imu", "Imu"),
        ("cluster/main/state", "ClusterState"),
    ):
        assert re.search(rf"^{key} +{message} +\d+$", keys, re.MULTILINE), keys
    echoed = [json.loads(line) for line in terminal("echo", "drone/*/truth", "-n", "4").splitlines()]
    assert {line["key"] for line in echoed} == {"drone/drone1/truth", "drone/drone2/truth"}
    assert all(len(line["message"]["position_m"]) == 3 for line in echoed)
    (raw,) = terminal("echo", "clock", "-n", "1", "--raw").splitlines()
    assert bytes.fromhex(json.loads(raw)["message"]).startswith(b"\x87")  # a msgpack map of seven fields
    assert re.search(
        r"[\d.]+ Hz wall \(gap .*\), 50\.0 Hz simulated, \d+ messages", terminal("hz", "clock", "--seconds", "2.5")
    )
    assert "no message on nothing/here yet" in terminal("hz", "nothing/here", "--seconds", "1.5")
    assert terminal("ask", "world/control", "stop") == "ok\n"
    flying.ends(with_code=0)


def test_asking_the_world(federation: Federation) -> None:
    world = federation.world(ONE, "--rate", "4", "--duration", "1000")
    client = federation.client()
    clock = client.watch("clock")
    clock.until(lambda m: m["t_ns"] > 0)
    terminal = Terminal(federation)
    assert terminal("ask", "world/control", "pause") == "ok\n"
    paused = clock.until(lambda m: m["state"] == "paused").message["t_ns"]
    assert terminal("ask", "world/control", "step", '{"gates": 5}') == "ok\n"
    clock.until(lambda m: m["state"] == "paused" and m["t_ns"] == paused + 100_000_000)
    assert terminal("ask", "world/control", "resume") == "ok\n"
    clock.until(lambda m: m["state"] == "running")
    assert terminal("ask", "world/control", "rate", '{"value": 20}') == "ok\n"
    clock.until(lambda m: m["rate"] > 15)
    said = terminal("pub", "drone/drone1/cmd/mode", '{"mode": "takeoff"}')
    assert said == "published 1 on drone/drone1/cmd/mode\n"
    states = client.watch("drone/drone1/sensor/status")
    states.until(lambda m: m["state"] == "hovering")
    velocity = '{"velocity_m_s": [0, 0, 0.5], "yaw_rate_rad_s": 0}'
    said = terminal("pub", "drone/drone1/cmd/velocity", velocity, "-n", "3", "--rate-hz", "100")
    assert said == "published 3 on drone/drone1/cmd/velocity\n"
    assert states.until(lambda m: m["state"] == "flying").message["commander"] == "zsim.pub"
    assert terminal("ask", "world/control", "stop", '{"reason": "enough"}') == "ok\n"
    world.line("stopped by zsim.ask: enough")
    world.ends(with_code=0)


def test_asking_a_controller(federation: Federation, flying: Role) -> None:
    terminal = Terminal(federation)
    state = federation.client().watch("cluster/main/state")
    state.until(lambda m: m["phase"] == "engaged")
    assert terminal("ask", "cluster/main/control", "hold") == "ok\n"
    state.until(lambda m: m["phase"] == "held")
    assert terminal("ask", "cluster/main/control", "engage") == "ok\n"
    before = state.until(lambda m: m["phase"] == "engaged").message
    target = {"values": {"z_c": 2.5}, "over_s": 6}
    assert terminal("ask", "cluster/main/control", "target", json.dumps(target)) == "ok\n"
    place = before["names"].index("z_c")
    state.until(lambda m: m["desired"][place] == pytest.approx(2.5))
    assert "nothing" in terminal("ask", "cluster/main/control", "target", '{"values": {"nothing": 1}}', code=2)
    assert terminal("ask", "cluster/main/control", "land") == "ok\n"
    state.until(lambda m: m["phase"] == "idle")
    terminal("ask", "world/control", "stop")
    flying.ends(with_code=0)


BAD_COMMANDS = {
    "no json": (("pub", "drone/drone1/cmd/mode", "{mode"), "the message is no JSON"),
    "no map": (("pub", "drone/drone1/cmd/mode", "[1]"), "must be a map such as"),
    "no such mode": (("pub", "drone/drone1/cmd/mode", '{"mode": "x"}'), "mode is 'x'; must be one of"),
    "unknown key": (("pub", "drone/drone1/fly", "{}"), "is no key of the contract"),
    "no op": (("ask", "world/control", "jump"), "op is 'jump'; must be one of pause"),
    "args no json": (("ask", "world/control", "step", "{x"), "args is no JSON"),
    "args no map": (("ask", "world/control", "step", "3"), "must be a map such as"),
    "nobody answers": (("ask", "cluster/nobody/control", "land"), "nobody answers there; is it running?"),
    "ask of several": (("ask", "world/*", "pause"), "takes one key, without wildcards"),
    "ask as in ros2": (("ask", "/world/control", "pause"), "must be world/control, without / at its ends"),
    "ask of no key": (("ask", "world//control", "pause"), "key is 'world//control' (empty chunks are forbidden"),
    "a huge argument": (("ask", "world/control", "step", f'{{"gates": {10**22}}}'), "args cannot be sent"),
    "a word of ours": (("ask", "world/control", "rate", '{"source": "me"}'), "value is None; must be from 0"),
    "echo as in ros2": (("echo", "/clock"), "must be clock, without / at its ends"),
    "echo of nothing": (("echo", ""), "key is ''"),
    "echo of no key": (("echo", "drone/#$?/x"), "key is 'drone/#$?/x'"),
    "hz of no key": (("hz", "drone//x"), "must be drone/x"),
    "pub to a ghost": (("pub", "drone/ghost/cmd/mode", '{"mode": "land"}'), "must be one of drone1"),
    "pub to all": (("pub", "drone/*/cmd/mode", '{"mode": "land"}'), "takes one key, without wildcards"),
    "pub for the world": (("pub", "clock", "{}"), "only the process that this is about speaks here"),
}


def test_bad_commands(federation: Federation) -> None:
    world = federation.world(ONE, "--rate", "1", "--duration", "1000")
    federation.client().watch("clock").until(lambda m: m["t_ns"] > 0)
    for arguments, reason in BAD_COMMANDS.values():
        said = Terminal(federation)(*arguments, code=2)
        assert reason in said
        assert len([line for line in said.splitlines() if not line.startswith("waiting for a world of")]) == 1
    federation.client().request("world/control", "stop")
    world.ends(with_code=0)


@pytest.mark.parametrize("command", COMMANDS)
def test_help(command: str) -> None:
    text = zsim(command, "--help").stdout
    assert f"zsim_deploy.cli {command}" in text or f"zsim {command}" in text
    assert "--launched" not in text


def test_help_of_all() -> None:
    text = zsim("--help").stdout
    for command in COMMANDS:
        assert re.search(rf"\b{command}\b", text)
    assert zsim("--version").stdout.startswith("zsim 0.")


def test_validate_prints_what_a_scenario_resolves_to(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(ONE)
    resolved = zsim("validate", str(path), "--set", "seed=77").stdout
    assert "seed: 77" in resolved
    path.write_text(resolved)
    assert zsim("validate", str(path)).stdout == resolved


def test_report_of_a_run(federation: Federation) -> None:
    federation.run(PAIR, "--in-process", "--duration", "8").ends(with_code=0)
    said = zsim("report", str(federation.out)).stdout
    assert f"report: {federation.out / 'report.html'}" in said
    summary = json.loads((federation.out / "summary.json").read_text())
    assert summary["truth_sha256"] == federation.record().sha256()
    assert summary["seed"] == 3
    assert (federation.out / "report.html").stat().st_size > 1000
