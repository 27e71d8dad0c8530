"""Bad input: for each a clear line and an exit code, or a counted refusal; nothing lost, nothing hanging."""

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from federation import ONE, PAIR, Federation, free_port

GARBAGE = 100_000  # messages
FOR_LONG = ("--rate", "1", "--duration", "600")

# name: (the scenario, what the line must say)
SCENARIOS = {
    "unknown key": (ONE + "wings: 2\n", "wings is not known; allowed: "),
    "wrong type": (ONE.replace("seed: 3", "seed: soon"), "seed is 'soon'; must be"),
    "not a number": (
        ONE.replace("duration_s:", "duration_s: .nan #"),
        "duration_s is nan; must be a finite number > 0",
    ),
    "no drones": ("name: empty\nduration_s: 1\ndrones: []\n", "drones has 0 entries; must have 1 to 1000"),
    "absurd size": ("name: big\nduration_s: 1e30\ndrones: [{name: a, position_m: [0, 0, 0]}]\n", "must be > 0 and <="),
    "not yaml": ("name: [\n", "is not YAML"),
    "no map": ("- 1\n", "must be a map as in"),
}

# name: (arguments, what the line must say); {world} is a taken endpoint, {free} one where nobody listens
COMMANDS = {
    "negative mass": (
        ("validate", "scenarios/step.yaml", "--set", "drones.drone3.mass_kg=-1.4"),
        "step.yaml: drones[2].mass_kg is -1.4; must be > 0 and <= 100 (drone 'drone3')",
    ),
    "no file": (("validate", "nowhere.yaml"), "cannot be read"),
    "bad --set": (("validate", "scenarios/step.yaml", "--set", "drones.drone9.mass_kg=1"), "allowed: 0 to 2"),
    "port in use": (("world", "scenarios/step.yaml", "--listen", "{world}"), "Address already in use"),
    "malformed endpoint": (("world", "scenarios/step.yaml", "--listen", "nonsense"), "endpoint is 'nonsense'; must be"),
    "no world within --wait": (("estimator", "drone1", "--connect", "{free}", "--wait", "0.5"), "within 0.5 s"),
    "other federation": (
        ("estimator", "drone1", "--connect", "{world}", "--federation", "other", "--wait", "0.5"),
        "no world of federation 'other'",
    ),
    "unknown drone": (("estimator", "drone9", "--connect", "{world}"), "drone is 'drone9'; must be one of drone1"),
    "unknown cluster": (("controller", "nobody", "--connect", "{world}"), "cluster is 'nobody'; must be one of"),
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_bad_scenario_is_a_line(federation: Federation, name: str) -> None:
    text, says = SCENARIOS[name]
    role = federation.start("validate", federation.write(text))
    role.ends(with_code=2)
    assert says in role.text()
    assert "Traceback" not in role.text()


def test_bad_commands_are_a_line_each(federation: Federation) -> None:
    world = federation.world(ONE, *FOR_LONG)
    federation.client().watch("clock").until(lambda m: m["t_ns"] > 0)
    places = {"{world}": federation.endpoint, "{free}": f"tcp/127.0.0.1:{free_port()}"}
    roles = {
        name: federation.start(*[str(places.get(word, word)) for word in arguments])
        for name, (arguments, _) in COMMANDS.items()
    }
    for name, role in roles.items():
        role.ends(with_code=2)
        assert COMMANDS[name][1] in role.text(), name
        assert "Traceback" not in role.text()
    federation.client().ask("world/control", "stop")
    world.ends(with_code=0)


def test_of_two_processes_of_one_name_the_older_ends(federation: Federation) -> None:
    world = federation.world(ONE, *FOR_LONG)
    events = federation.client().watch("world/event")
    older = federation.role("estimator", "drone1")
    events.until(lambda m: m["kind"] == "join" and m["subject"] == "estimator.drone1")
    newer = federation.role("estimator", "drone1")
    older.ends(with_code=3)
    assert "another process of this name joined" in older.text()
    federation.client().ask("world/control", "stop")
    newer.ends(with_code=0)
    world.ends(with_code=0)


def test_a_run_is_never_written_over(federation: Federation) -> None:
    federation.out.mkdir()
    (federation.out / "run.mcap").write_bytes(b"precious")
    role = federation.run(ONE)
    role.ends(with_code=2)
    assert "holds a run already; give --out another folder" in role.text()
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
    assert "No space left on device" in role.text()
    record = federation.record()
    assert record.keys()["clock"] > 50
    federation.nobody_left()


def test_garbage_is_counted_and_changes_nothing(federation: Federation) -> None:
    """The same run with and without a client that floods commands, process keys and requests."""
    folder = federation.folder / "calm"
    folder.mkdir()
    with Federation(folder) as calm:
        calm.run(PAIR, "--duration", "8").ends(with_code=0)
        undisturbed = calm.record().sha256()
    role = federation.run(PAIR, "--duration", "8", "--rate", "2")
    client = federation.client()
    client.watch("clock").until(lambda m: m["step"] > 5)
    for number in range(GARBAGE // 4):
        client.put_raw("drone/drone1/cmd/velocity", b"garbage")
        client.put_raw("drone/drone2/cmd/mode", bytes([number % 256]) * 20)
        client.put_raw(f"process/{number % 50}/join", b"\x81\xa4t_ns\xc0")
        client.put_raw("drone/nobody/cmd/rotors", b"\xc1" * 50)
    answer = client.ask("world/control", "explode")
    assert not answer["ok"]
    role.ends(with_code=0)
    record = federation.record()
    assert record.end()["refused"] >= GARBAGE
    assert len(record.events("refused")) < 5_000
    assert record.sha256() == undisturbed
