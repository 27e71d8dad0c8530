"""Bad input is answered by a clear line and an exit code or counted as refused; nothing is lost, nothing hangs."""

import errno
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import forked_commands
import pytest
from federation import ONE, PAIR, PAIR_ROLES, Federation, free_port
from forked_commands import ROOT, USER_FAULT, ZSIM, refusal, run_here
from refused import has_terms, parts
from wire import PATIENCE_S, kinds

SUPERSEDED = 3  # exit code
FOR_LONG = ("--rate", "1", "--duration", "600")
ON_THE_DRONE = "yaw_deg: 90"
NO_DRONES = ONE.split("drones:")[0]

# name: (scenario, terms that the line must contain)
SCENARIOS: dict[str, tuple[str, tuple[str, ...]]] = {
    "unknown key": (ONE + "wings: 2\n", ("wings", "drones")),
    "unknown key of a drone": (ONE.replace("yaw_deg", "yaw"), ("drones[0].yaw", "arm_m")),
    "wrong type": (ONE.replace("seed: 3", "seed: soon"), ("seed is 'soon'",)),
    "text for a number": (ONE.replace("duration_s: 10", "duration_s: long"), ("duration_s is 'long'",)),
    "a list for a map": (ONE.replace("{expect: []}", "[]"), ("processes is []",)),
    "not a number": (ONE.replace("gust_m_s: 0.3", "gust_m_s: .nan"), ("environment.wind.gust_m_s", "nan", ">= 0")),
    "infinite": (ONE.replace("duration_s: 10", "duration_s: .inf"), ("duration_s is inf", "> 0")),
    "absurd duration": (ONE.replace("duration_s: 10", "duration_s: 1e30"), ("duration_s is 1e+30", "<= 1e+06")),
    "absurd place": (ONE.replace("[0, 0, 0]", "[1e9, 0, 0]"), ("drones[0].position_m[0]", "1000000000.0", "<= 100000")),
    "under the ground": (ONE.replace("[0, 0, 0]", "[0, 0, -1]"), ("drones[0].position_m[2]", "-1", ">= 0")),
    "negative mass": (ONE.replace(ON_THE_DRONE, "mass_kg: -1.4"), ("drones[0].mass_kg", "-1.4", "<= 100")),
    "mass of a man": (ONE.replace(ON_THE_DRONE, "mass_kg: 90"), ("drones[0].mass_kg", "90", "<")),
    "gate of no time": (ONE + "time: {gate_ms: 0}\n", ("time.gate_ms is 0", "<= 1000")),
    "drones missing": (NO_DRONES, ("drones is missing",)),
    "no drones": (NO_DRONES + "drones: []\n", ("drones", "0", "1000")),
    "too many drones": (NO_DRONES + f"drones: [{'{},' * 1001}]\n", ("drones", "1001", "1000")),
    "a name with a slash": (ONE.replace("name: drone1", "name: a/b"), ("drones[0].name is 'a/b'",)),
    "two of one name": (PAIR.replace("drone2", "drone1", 1).split("clusters")[0], ("drones[1].name is 'drone1'",)),
    "two in one place": (PAIR.replace("[-2, 0, 0]", "[2, 0, 0]"), ("is 0.00 m", "'drone1'", ">=")),
    "a cluster of strangers": (PAIR.replace("[drone1,", "[drone7,"), ("is 'drone7'",)),
    "bad on_death": (
        ONE.replace("expect: []", "on_death: {world: sing}"),
        ("processes.on_death.world", "'sing'", "restart"),
    ),
    "not yaml": ("name: [\n", ("YAML",)),
    "no map": ("- 1\n", ("map",)),
    "empty": ("", ("empty", "map")),
    "a key twice": (ONE + "seed: 4\n", ("'seed'", "twice")),
    "an alias bomb": ("a: &a [1]\nb: [*a, *a]\n", ("aliases",)),
}


def test_a_bad_scenario_is_reported_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    for name, (text, tokens) in SCENARIOS.items():
        path.write_text(text)
        line = refusal("run", str(path), "--out", str(tmp_path / "out"))
        assert has_terms(line, *tokens), (name, line)
        assert line.startswith("bad.yaml: "), name
    assert not (tmp_path / "out").exists()


def test_all_faults_of_a_scenario_are_reported_at_once(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(ONE.replace("seed: 3", "seed: -1").replace(ON_THE_DRONE, "mass_kg: 0") + "wings: 3\n")
    done = forked_commands.run("validate", str(path))
    assert done.code == USER_FAULT
    assert sorted(parts(line)[0] for line in done.stderr.splitlines()) == ["drones[0].mass_kg", "seed", "wings"]


# name: (arguments, terms that the line must contain); {free} is an endpoint on which no process listens
COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "no file": (("run", "nowhere.yaml"), ("nowhere.yaml: ", "No such file")),
    "a folder": (("validate", "/"), ("/: ", "Is a directory")),
    "set without value": (("run", "{one}", "--set", "seed"), ("--set seed: ", "a.b.c=value")),
    "set of an unknown key": (("run", "{one}", "--set", "wings.gust=1"), ("wings ",)),
    "set of an unknown drone": (("run", "{one}", "--set", "drones.drone9.mass_kg=1"), ("drone9 ", "drones")),
    "set of a bad value": (("run", "{one}", "--set", "seed=[1"), ("YAML",)),
    "negative duration": (("run", "{one}", "--duration", "-1"), ("duration_s is -1.0", "> 0")),
    "no world": (("estimator", "drone1", "--connect", "{free}", "--wait", "0.5"), ("'zsim'", "0.5 s", "`zsim world`")),
    "no world to look at": (("keys", "--connect", "{free}", "--wait", "0.5"), ("'zsim'", "0.5 s", "`zsim world`")),
    "no world to record": (("record", "--connect", "{free}", "--wait", "0.5"), ("'zsim'", "0.5 s", "`zsim world`")),
    "malformed endpoint": (("world", "{one}", "--listen", "nonsense"), ("endpoint is 'nonsense'",)),
    "malformed connect": (("keys", "--connect", "nonsense"), ("endpoint is 'nonsense'",)),
    "unknown protocol": (("world", "{one}", "--listen", "pigeon/1"), ("endpoint is 'pigeon/1'", "tcp")),
    "unknown protocol to connect": (("keys", "--connect", "pigeon/1"), ("endpoint is 'pigeon/1'", "tcp")),
    "address of others": (
        ("world", "{one}", "--listen", "tcp/192.0.2.1:7000", "--insecure"),
        ("tcp/192.0.2.1:7000",),
    ),
    "open to a network": (("world", "{one}", "--listen", "tcp/0.0.0.0:7000"), ("tcp/0.0.0.0:7000", "--insecure")),
    "a run open to it": (("run", "{one}", "--listen", "tcp/[::]:7000"), ("tcp/[::]:7000", "--insecure")),
    "in the clear": (
        ("estimator", "drone1", "--connect", "tcp/192.0.2.1:7000"),
        ("tcp/192.0.2.1:7000", "--insecure"),
    ),
    "port 0": (("world", "{one}", "--listen", "tcp/127.0.0.1:0"), ("tcp/127.0.0.1:0", "port 0")),
    "no federation": (("keys", "--connect", "{free}", "--federation", "a/b"), ("federation is 'a/b'",)),
    "no record": (("report", "{folder}"), ("run.mcap",)),
    "an empty record": (("report", "{folder}/cut"), ("cut/run.mcap: ",)),
    "no such option": (("estimator", "-._"), ("zsim estimator: ", "option: -", "`zsim estimator --help`")),
    "no such command": (("fly",), ("zsim: ", "'fly'", "`zsim --help`")),
    "no scenario": (("run",), ("zsim run: ", "`zsim run --help`")),
    "no number": (("run", "{one}", "--seed", "x"), ("'--seed'", "integer")),
    "in-process at a pace": (("run", "{one}", "--in-process", "--rate", "3"), ("--in-process", "--rate")),
    "in-process, listening": (("run", "{one}", "--in-process", "--listen", "tcp/[::1]:20000"), ("--listen",)),
    "a run on no endpoint": (("run", "{one}", "--listen", "bogus"), ("endpoint is 'bogus'",)),
    "a run on no port": (("run", "{one}", "--listen", "tcp/127.0.0.1"), ("'tcp/127.0.0.1'", "tcp/ADDRESS:PORT")),
    "a run on port 0": (("run", "{one}", "--listen", "tcp/127.0.0.1:0"), ("port 0",)),
    "a folder of no files": (("run", "{one}", "--out", "/proc"), ("/proc: ",)),
    "such a folder, in-process": (("run", "{one}", "--in-process", "--out", "/proc"), ("/proc: ",)),
    "negative wait": (("keys", "--wait", "-1"), ("is -1; ", ">= 0")),
    "wait of no length": (("keys", "--wait", "nan"), ("is nan; ", ">= 0")),
    "hz for no time": (("hz", "clock", "--seconds", "0"), ("is 0; ", "> 0")),
    "echo of nothing": (("echo", "clock", "-n", "0"), ("'--count'",)),
    "pub at no rate": (("pub", "clock", "{{}}", "--rate-hz", "nan"), ("'--rate-hz'",)),
    "expecting a ghost": (("run", "{one}", "--set", "processes.expect=[estimator.ghost]"), ("'ghost'",)),
    "unwritable out": (("run", "{one}", "--out", "/proc/zsim"), ("/proc/zsim: ",)),
    "out is a file": (("run", "{one}", "--out", "{one}"), ("one.yaml: ",)),
    "a bad plan, looked at": (
        ("validate", "{bad}"),
        ("bad.yaml: clusters[0].plan.trajectory.expressions.x_c", "'sin('"),
    ),
    "a bad plan": (
        ("run", "{bad}", "--in-process", "--out", "{folder}/e"),
        ("bad.yaml: clusters[0].plan.trajectory.expressions.x_c", "'sin('"),
    ),
}


def test_a_bad_command_is_reported_in_one_line(tmp_path: Path, compiled: None) -> None:
    (tmp_path / "one.yaml").write_text(ONE)
    (tmp_path / "bad.yaml").write_text(with_expression("sin("))
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "run.mcap").write_bytes(b"")
    places = {"one": tmp_path / "one.yaml", "bad": tmp_path / "bad.yaml", "folder": tmp_path}
    for name, (arguments, tokens) in COMMANDS.items():
        line = refusal(*(argument.format(**places, free=f"tcp/127.0.0.1:{free_port()}") for argument in arguments))
        assert has_terms(line, *tokens), (name, line)


def with_expression(text: str) -> str:
    """Return PAIR with a trajectory whose x_c is this expression."""
    plan = f'{{takeoff_s: 0.5, trajectory: {{expressions: {{x_c: "{text}"}}}}}}'
    return PAIR.replace("{takeoff_s: 0.5}", plan)


def test_an_invalid_expression_in_a_plan_ends_the_run(federation: Federation) -> None:
    run = federation.run(with_expression("sin("))
    assert run.process.wait(PATIENCE_S) != 0
    run.close()
    for text, token in (("2*omega*t", "omega"), ("__import__('os')", "x_c"), ("1/0", "x_c")):
        done = run_here("run", federation.write(with_expression(text)), "--in-process", "--out", str(federation.out))
        assert done.code != 0
        assert token in done.stderr
        assert "Traceback" not in done.stderr
    assert "x_c" in run.text()
    assert "Traceback" not in run.text()
    federation.nobody_left()


# name: (arguments of a role, text that its output must contain)
ROLES = {
    "wrong federation": (
        ("estimator", "drone1", "--federation", "other", "--wait", "1"),
        "'other'",
    ),
    "unknown drone": (("estimator", "drone9"), "drone is 'drone9'"),
    "unknown cluster": (("controller", "nobody"), "cluster is 'nobody'"),
    "unwritable record": (("record", "--out", "/proc/zsim"), "/proc/zsim"),
}


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Iterator[Federation]:
    """A world in real time that waits for no process and must survive the tests of this file."""
    with Federation(tmp_path_factory.mktemp("standing")) as federation:
        role = federation.world(ONE, *FOR_LONG)
        client = federation.client()
        client.subscribe("clock").until(lambda m: m["t_ns"] > 0)
        yield federation
        assert client.get("clock")["clock"]["state"] == "running"
        client.request("world/control", "stop")
        role.ends(with_code=0)


def test_roles_with_invalid_arguments_are_refused(standing: Federation) -> None:
    roles = {name: standing.role(*arguments) for name, (arguments, _) in ROLES.items()}
    for name, role in roles.items():
        role.ends(with_code=USER_FAULT)
        assert ROLES[name][1] in role.text(), name
        assert "Traceback" not in role.text()


def test_a_port_in_use_is_refused(standing: Federation) -> None:
    """Neither a world nor a run can listen on it, and no role of that run joins the world that does."""
    second = standing.world(ONE)
    second.ends(with_code=USER_FAULT)
    assert standing.endpoint in second.text()
    events = standing.client().subscribe("world/event")
    run = standing.run(ONE)
    run.ends(with_code=1)
    assert standing.endpoint in run.text()
    assert "Traceback" not in run.text() + second.text()
    assert "join" not in kinds(events.now())


@pytest.mark.parametrize("name", ["estimator.drone1", pytest.param("recorder", marks=pytest.mark.soak)])
def test_a_process_is_superseded_by_a_newer_one_of_its_name(standing: Federation, name: str) -> None:
    events = standing.client().subscribe("world/event")
    arguments = [("estimator", "drone1")] * 2
    if name == "recorder":
        arguments = [("record", "--out", str(standing.folder / place)) for place in "ab"]
    older = standing.role(*arguments[0])
    events.until(lambda m: (m["kind"], m["subject"]) == ("join", name))
    newer = standing.role(*arguments[1])
    older.ends(with_code=SUPERSEDED)
    assert re.search(rf"^{name}: ", older.text(), re.MULTILINE)
    assert newer.process.poll() is None  # it stays, since a process that leaves early fails the run


def test_a_record_is_never_overwritten(federation: Federation) -> None:
    federation.out.mkdir()
    (federation.out / "run.mcap").write_bytes(b"precious")
    role = federation.run(ONE)
    role.ends(with_code=USER_FAULT)
    assert has_terms(role.text(), str(federation.out), "--out")
    assert (federation.out / "run.mcap").read_bytes() == b"precious"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of one megabyte."""
    if os.geteuid() != 0:
        pytest.skip("mounting a small file system needs root")
    folder = tmp_path / "small"
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)], check=True)
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_disk_ends_the_run_and_keeps_the_record(federation: Federation, small_disk: Path) -> None:
    federation.out = small_disk / "run"
    role = federation.run(PAIR, "--duration", "600")
    role.ends(with_code=1)
    assert os.strerror(errno.ENOSPC) in role.text()
    federation.nobody_left()
    federation.out = Path(
        shutil.copytree(federation.out, federation.folder / "kept")
    )  # repairing the record takes space
    assert federation.record().keys()["clock"] > 0


def test_a_limit_on_file_size_ends_the_recorder_and_keeps_the_record(federation: Federation) -> None:
    """The limit on the recorder's files stands in for a full disk where the tests may not mount one."""
    world = federation.world(ONE, "--rate", "20", "--duration", "10000", "--expect", "recorder")
    command = [*ZSIM, "record", "--out", str(federation.out), "--connect", federation.endpoint]
    limited = ["bash", "-c", 'trap "" XFSZ; ulimit -f 300; exec "$@"', "bash", *command]  # KiB
    done = subprocess.run(limited, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == USER_FAULT, done.stderr
    assert os.strerror(errno.EFBIG) in done.stderr
    assert "Traceback" not in done.stderr
    world.ends(with_code=0)
    assert re.search(r"^ended: .*recorder", world.text(), re.MULTILINE)
    assert federation.record().keys()["clock"] > 0


FLOODS, FLOODED_NS, GATE_NS = "tester.one", 8 * 10**9, 20_000_000
GARBAGE = 30_000  # messages
GARBAGE_KEYS = (
    "drone/drone1/cmd/velocity",
    "drone/drone2/cmd/mode",
    "drone/nobody/cmd/rotors",
    "drone/drone1/estimate",
    "drone/drone1/truth",
    "drone/drone1/sensor/status",
    "drone/drone1/camera/front",
    "drone/drone1/camera/front/info",
    "drone/drone2/camera/side",
    "drone/drone1/sightings",
    "drone/drone1/sensor/sightings",
    "cluster/main/state",
    "process/estimator.drone1/done",
    "process/estimator.drone1/join",
    "process/no name/bye",
    "process/x.y/health",
    "clock",
    "world/event",
    "world/info",
    "@batch",
)


def test_garbage_is_counted_and_changes_nothing(federation: Federation) -> None:
    """The same run with and without a client that floods every kind of key, and for which time waits at each gate."""
    folder = federation.folder / "calm"
    folder.mkdir()
    with Federation(folder) as calm:
        calm.run(PAIR, "--in-process", "--duration", f"{FLOODED_NS // 10**9}").ends(with_code=0)
        undisturbed = calm.record().sha256()
    expected = f"processes.expect=[{', '.join((*PAIR_ROLES, 'recorder', FLOODS))}]"
    role = federation.run(PAIR, "--duration", f"{FLOODED_NS // 10**9}", "--set", expected)
    client = federation.client()
    me, clock = client.join(FLOODS, client.info(), GATE_NS), client.subscribe("clock")
    payloads = (
        b"\xc1",
        b"garbage",
        b"\x90",
        b"\x81\xa4t_ns\xc0",
        client.pack({"t_ns": 1}),
        os.urandom(64),
        b"\x81" * 5000,
        client.pack({"t_ns": 1, "seq": 0, "source": ""})[:-1] + b"\xa1\xff",  # not UTF-8
        client.pack({"t_ns": 1, "seq": 0, "x": 0})[:-1] + b"\x91" * 5000 + b"\xc0",  # nested lists
    )
    numbers, gates = iter(range(GARBAGE)), range(0, FLOODED_NS + 1, GATE_NS)
    for gate_ns in gates:
        clock.until(lambda m, t_ns=gate_ns: isinstance(m, dict) and m.get("step", -1) >= 0 and m["t_ns"] >= t_ns)
        for number in islice(numbers, GARBAGE // len(gates) + 1):
            key = GARBAGE_KEYS[number % len(GARBAGE_KEYS)]
            client.put_raw(key, payloads[number // len(GARBAGE_KEYS) % len(payloads)])
        if gate_ns < FLOODED_NS:
            me.done(gate_ns)
    answers = [client.get("world/control", payload=payload)["world/control"] for payload in payloads]
    assert not any(answer["ok"] for answer in answers)
    me.done(FLOODED_NS)
    me.bye(FLOODED_NS)
    role.ends(with_code=0)
    record = federation.record()
    assert record.sha256() == undisturbed
    assert record.end()["refused"] >= GARBAGE // len(GARBAGE_KEYS) * 9  # the world reads 9 of the keys
    assert len(record.events("refused")) < 5_000
