"""A table of what users and strangers get wrong: each a clear line or a counted refusal, and nothing hangs."""

import os
import resource
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from federation import ONE, PAIR, PAIR_ROLES, ROOT, ZSIM, Federation, free_port
from wire import PATIENCE_S, Client

USER_FAULT = 2
SUPERSEDED = 3


def refused(*arguments: str, code: int = USER_FAULT) -> str:
    """Run a command that must be refused; return its lines."""
    done = subprocess.run(
        [*ZSIM, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    return done.stderr


SCENARIOS: dict[str, tuple[Callable[[str], str], str]] = {
    "unknown key": (lambda s: s + "winds: 3\n", "winds is not known; allowed: clusters, drones"),
    "unknown key of a drone": (lambda s: s.replace("yaw_deg", "yaw"), "drones[0].yaw is not known; allowed: arm_m"),
    "wrong type": (lambda s: s.replace("seed: 3", "seed: three"), "seed is 'three'; must be a whole number"),
    "text for a number": (lambda s: s.replace("duration_s: 10", "duration_s: long"), "duration_s is 'long'; must be a"),
    "a list for a map": (lambda s: s.replace("{expect: []}", "[]"), "processes is []; must be a map"),
    "nan": (lambda s: s.replace("gust_m_s: 0.3", "gust_m_s: .nan"), "gust_m_s is nan; must be a finite number >= 0"),
    "infinite": (lambda s: s.replace("duration_s: 10", "duration_s: .inf"), "duration_s is inf; must be a finite"),
    "absurd duration": (
        lambda s: s.replace("duration_s: 10", "duration_s: 1e9"),
        "duration_s is 1000000000.0; must be",
    ),
    "absurd place": (lambda s: s.replace("[0, 0, 0]", "[1e9, 0, 0]"), "position_m[0] is 1000000000.0; must be"),
    "under the ground": (lambda s: s.replace("[0, 0, 0]", "[0, 0, -1]"), "position_m[2] is -1; must be >= 0"),
    "negative mass": (lambda s: s.replace("yaw_deg: 90", "mass_kg: -1"), "mass_kg is -1; must be > 0 and <= 100"),
    "mass of an aeroplane": (lambda s: s.replace("yaw_deg: 90", "mass_kg: 90"), "mass_kg is 90; must be < 0."),
    "gate of no step": (lambda s: s + "time: {gate_ms: 0}\n", "time.gate_ms is 0; must be > 0 and <= 1000"),
    "no drones": (lambda s: s.split("drones:")[0], "drones is missing; must be a list"),
    "no drone": (lambda s: s.split("drones:")[0] + "drones: []\n", "drones has 0 entries; must have at least 1"),
    "too many drones": (
        lambda s: s.split("drones:")[0] + "drones: [" + ", ".join("{}" for _ in range(1001)) + "]\n",
        "drones has 1001 entries; must have 1 to 1000",
    ),
    "a name with a slash": (lambda s: s.replace("name: drone1", "name: a/b"), "drones[0].name is 'a/b'; must match"),
    "two of one name": (lambda s: PAIR.replace("drone2, pos", "drone1, pos"), "drones[1].name is 'drone1'"),
    "two in one place": (lambda s: PAIR.replace("[-2, 0, 0]", "[2, 0, 0]"), "is 0.00 m from 'drone1'; must be >="),
    "a cluster of strangers": (
        lambda s: PAIR.replace("drones: [drone1,", "drones: [drone7,"),
        "is 'drone7'; must be one",
    ),
    "no yaml": (lambda s: "name: [", "is not YAML ("),
    "no map": (lambda s: "- 1\n", "holds [1]; must be a map"),
    "empty": (lambda s: "", "holds null; must be a map"),
    "a key twice": (lambda s: s + "seed: 4\n", "key 'seed' is given twice"),
    "an alias bomb": (lambda s: "a: &a [1]\nb: [*a, *a]\n", "aliases are not allowed"),
    "on_death of another kind": (
        lambda s: s.replace("{expect: []}", "{on_death: {world: sing}}"),
        "is 'sing'; must be one",
    ),
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_scenarios(tmp_path: Path, name: str) -> None:
    change, reason = SCENARIOS[name]
    path = tmp_path / "bad.yaml"
    path.write_text(change(ONE))
    said = refused("run", str(path), "--out", str(tmp_path / "out"))
    assert reason in said
    assert "bad.yaml" in said
    assert not (tmp_path / "out").exists()


def test_every_fault_of_a_scenario_is_told_at_once(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(ONE.replace("seed: 3", "seed: -1").replace("yaw_deg: 90", "mass_kg: 0") + "winds: 3\n")
    said = refused("validate", str(path))
    assert len(said.splitlines()) == 3
    assert "drone1" in said  # the drone whose mass it is


COMMANDS: dict[str, tuple[tuple[str, ...], str]] = {
    "missing file": (("run", "/nowhere/x.yaml"), "/nowhere/x.yaml: cannot be read (No such file or directory)"),
    "a folder": (("validate", "/"), "cannot be read (Is a directory)"),
    "set without value": (("run", "{one}", "--set", "seed"), "--set seed: is no assignment; must be a.b.c=value"),
    "set of an unknown key": (("run", "{one}", "--set", "wind.gust=1"), "wind is not known"),
    "set of an unknown drone": (("run", "{one}", "--set", "drones.drone9.mass_kg=1"), "drone9 is not in drones"),
    "set of a bad value": (("run", "{one}", "--set", "seed=[1"), "is not YAML"),
    "negative duration": (("run", "{one}", "--duration", "-1"), "duration_s is -1.0; must be > 0"),
    "no world": (
        ("estimator", "drone1", "--connect", "tcp/127.0.0.1:{free}", "--wait", "0.5"),
        "no world of federation",
    ),
    "no world to look at": (("keys", "--connect", "tcp/127.0.0.1:{free}", "--wait", "0.5"), "no world of federation"),
    "no world to record": (("record", "--connect", "tcp/127.0.0.1:{free}", "--wait", "0.5"), "no world of federation"),
    "malformed endpoint": (("world", "{one}", "--listen", "nonsense"), "cannot listen on nonsense"),
    "unknown transport": (("world", "{one}", "--listen", "pigeon/1"), "cannot listen on pigeon/1"),
    "address of others": (("world", "{one}", "--listen", "tcp/192.0.2.1:7000"), "cannot listen on tcp/192.0.2.1:7000"),
    "malformed connect": (("estimator", "drone1", "--connect", "nonsense", "--wait", "1"), "nonsense"),
    "no record": (("report", "{folder}"), "holds no run.mcap"),
    "unwritable out": (("run", "{one}", "--out", "/proc/zsim"), "/proc/zsim: cannot be made"),
    "out is a file": (("run", "{one}", "--out", "{one}"), "cannot be made"),
    "a bad expression": (("run", "{pair}", "--in-process", "--out", "{folder}/e"), "x_c"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_commands(tmp_path: Path, name: str) -> None:
    (tmp_path / "one.yaml").write_text(ONE)
    plan = "{takeoff_s: 0.5, trajectory: {expressions: {x_c: 'sin('}}}"
    (tmp_path / "pair.yaml").write_text(PAIR.replace("{takeoff_s: 0.5}", plan))
    arguments, reason = COMMANDS[name]
    places = {"one": tmp_path / "one.yaml", "pair": tmp_path / "pair.yaml", "folder": tmp_path, "free": free_port()}
    said = refused(*(argument.format(**places) for argument in arguments))
    assert reason in said
    assert len([line for line in said.splitlines() if not line.startswith("waiting for a world")]) == 1, said


EXPRESSIONS = {
    "not closed": ("sin(", "x_c"),
    "unknown name": ("2*omega*t", "omega"),
    "a call of another kind": ("__import__('os')", "x_c"),
    "attribute": ("t.real", "x_c"),
    "never finite": ("1/0", "x_c"),
    "empty": ("", "x_c"),
}


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_plans_as_processes(federation: Federation, name: str) -> None:
    """A plan that can never be flown ends the run at its start, with one line that says why."""
    expression, reason = EXPRESSIONS[name]
    plan = f'{{takeoff_s: 0.5, trajectory: {{expressions: {{x_c: "{expression}"}}}}}}'
    run = federation.run(PAIR.replace("{takeoff_s: 0.5}", plan))
    assert run.process.wait(PATIENCE_S) != 0
    run.close()
    assert "Traceback" not in run.text()
    assert reason in run.text()
    federation.nobody_left()


def test_a_folder_that_holds_a_run(federation: Federation) -> None:
    federation.run(ONE, "--in-process", "--duration", "1").ends(with_code=0)
    again = federation.run(ONE, "--in-process", "--duration", "1")
    again.ends(with_code=USER_FAULT)
    assert again.text() == f"{federation.out}: holds a run already; give --out another folder"


def test_a_port_in_use(federation: Federation) -> None:
    world = federation.world(ONE, "--rate", "1", "--duration", "1000")
    federation.client().watch("clock").until(lambda m: m["t_ns"] > 0)
    second = federation.world(ONE)
    second.ends(with_code=USER_FAULT)
    assert f"cannot listen on {federation.endpoint}" in second.text()
    assert "Traceback" not in second.text()
    run = federation.run(ONE)
    run.ends(with_code=1)
    assert f"cannot listen on {federation.endpoint}" in run.text()
    federation.client().ask("world/control", "stop")
    world.ends(with_code=0)
    federation.nobody_left()


@pytest.fixture
def slow_world(federation: Federation) -> Iterator[Client]:
    """PAIR's world that waits for nobody, at real time."""
    world = federation.world(PAIR, "--rate", "1", "--duration", "1000", "--set", "processes.expect=[]")
    client = federation.client()
    client.watch("clock").until(lambda m: m["t_ns"] > 0)
    yield client
    client.ask("world/control", "stop")
    world.ends(with_code=0)


ROLES = {
    "wrong federation": (
        ("estimator", "drone1", "--federation", "other", "--wait", "1"),
        "no world of federation 'other'",
    ),
    "federation of no name": (("estimator", "drone1", "--federation", "a/b", "--wait", "1"), "'a/b'; must be 1 to 32"),
    "unknown drone": (("estimator", "drone9"), "drone is 'drone9'; must be one of drone1, drone2"),
    "unknown cluster": (("controller", "other"), "cluster is 'other'; must be one of main"),
    "unwritable record": (("record", "--out", "/proc/zsim"), "/proc/zsim"),
}


def test_roles_that_do_not_fit(federation: Federation, slow_world: Client) -> None:
    for arguments, reason in ROLES.values():
        role = federation.role(*arguments)
        role.ends(with_code=USER_FAULT)
        assert reason in role.text()
        assert "Traceback" not in role.text()
    assert slow_world.get("clock")["clock"]["state"] == "running"


@pytest.mark.parametrize("name", ["estimator.drone1", "recorder"])
def test_two_of_one_name(federation: Federation, slow_world: Client, name: str) -> None:
    """The newer takes over, the older says so and ends."""
    role, _, thing = name.partition(".")
    arguments = ("estimator", thing) if thing else ("record",)
    outs = [("--out", str(federation.folder / place)) for place in "ab"] if role == "recorder" else [(), ()]
    events = slow_world.watch("world/event")
    older = federation.role(*arguments, *outs[0])
    events.until(lambda m: (m["kind"], m["subject"]) == ("join", name))
    newer = federation.role(*arguments, *outs[1])
    events.until(lambda m: (m["kind"], m["subject"]) == ("superseded", name))
    older.ends(with_code=SUPERSEDED)
    assert f"{name}: another process of this name joined from" in older.text()
    assert newer.process.poll() is None
    newer.signal(15)
    newer.ends(with_code=0)


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="no limits on the size of files here")
def test_a_full_disk(federation: Federation) -> None:
    """The recorder can write no more: the run ends and says so, and what was written can be read."""
    world = federation.world(ONE, "--rate", "20", "--duration", "10000", "--expect", "recorder")
    limit_kb = 300
    command = [*ZSIM, "record", "--out", str(federation.out), "--connect", federation.endpoint]
    shell = ["bash", "-c", f'trap "" XFSZ; ulimit -f {limit_kb}; exec "$@"', "bash", *command]
    done = subprocess.run(shell, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == USER_FAULT, done.stderr
    assert "Traceback" not in done.stderr
    assert "File too large" in done.stderr
    world.ends(with_code=0)
    assert "ended: the recorder left: " in world.text()
    record = federation.record()
    assert len(record.all("drone/drone1/truth")) > 100


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small disk needs root")
def test_a_full_disk_in_a_run(federation: Federation) -> None:
    federation.out.mkdir()
    size = "size=400k"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(federation.out)], check=True)
    try:
        run = federation.run(ONE, "--rate", "50", "--duration", "10000")
        run.ends(with_code=1)
        assert "No space left on device" in run.text()
        assert "Traceback" not in run.text()
        federation.nobody_left()
        assert len(federation.record().all("drone/drone1/truth")) > 100
    finally:
        subprocess.run(["umount", "-l", str(federation.out)], check=True)


GARBAGE = 100_000
GARBAGE_KEYS = (
    "drone/drone1/cmd/velocity",
    "drone/drone9/cmd/mode",
    "process/estimator.drone1/done",
    "process/estimator.drone1/join",
    "process/no name/bye",
    "process/x.y/health",
    "cluster/main/state",
    "drone/drone1/estimate",
    "drone/drone1/truth",
    "drone/drone1/sensor/status",
    "clock",
    "world/event",
    "world/info",
    "nothing/of/the/contract",
)


def test_garbage(federation: Federation, tmp_path_factory: pytest.TempPathFactory) -> None:
    """A stranger sends 100 000 messages of garbage to all keys; the run is what it would have been."""
    with Federation(tmp_path_factory.mktemp("undisturbed")) as undisturbed:
        undisturbed.run(PAIR, "--in-process").ends(with_code=0)
        wanted = undisturbed.record().sha256()
    run = federation.run(PAIR, "--rate", "4")
    client = federation.client()
    clock = client.watch("clock")
    clock.until(lambda m: m.get("t_ns", 0) > 1e9)
    lists = b"\x92\x01\x02"
    payloads = (b"", b"\xc1", b"\xff" * 100, client.pack({"t_ns": 1}), lists, os.urandom(64), b"\x81" * 5000)
    for number in range(GARBAGE):
        client.put_raw(GARBAGE_KEYS[number % len(GARBAGE_KEYS)], payloads[number // 7 % len(payloads)])
    for payload in payloads:
        answer = client.get("world/control", payload=payload)["world/control"]
        assert not answer["ok"]
    run.ends(with_code=0, within_s=180)
    record = federation.record()
    assert record.sha256() == wanted
    assert record.end()["refused"] > GARBAGE // 3
    assert len(record.events("refused")) < 50 * len(GARBAGE_KEYS)
    assert {event["subject"] for event in record.events("leave")} >= set(PAIR_ROLES)
