"""`zsim up` on three real hosts: the same bits as in one process, over TLS with access control, whatever fails."""

import itertools
import json
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from federation import ROOT, Record, Role
from lab import LAUNCHER, Lab

from zsim import scenario_file
from zsim.record import RecordReader, repair
from zsim_deploy.in_process import fly

STEP = ROOT / "scenarios" / "step.yaml"
ROLES = {"world": "h1", "controller.main": "h2", "estimator.*": ["h1", "h2", "h3"]}
DRONES = ("drone1", "drone2", "drone3")
FAKETIME = "/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1"
START_S = 60.0  # wall time until something of a run is seen on a machine that does other things too
GATES_PER_S = 50  # of Test 1
NAMED_AFTER_S = 2.0  # a host that is cut off for longer is named
DISK_BYTES = 1_500_000  # room for what a host needs and a few seconds of a record
CUT_IN_REALTIME_S = 5.0  # longer than the firmware's patience (0.5 s until it hovers, 2 s more until it lands)
LANDED_BY_WATCHDOG = ["landed", "taking_off", "hovering", "flying", "hovering", "landing"]
GONE_S = 15.0  # wall time within which nobody may be left on any host after its launcher is gone


class Team:
    """One lab with certificates, and the `zsim` commands that run in its launcher's namespace."""

    def __init__(self, lab: Lab, roles: dict[str, Any], secure: bool = True, **more: Any) -> None:
        self.lab = lab
        self.out = lab.folder / "out"
        self.hosts = str(lab.inventory(roles, insecure=not secure, **more))
        self._env = {"TMPDIR": str(lab.folder)}
        self.cut_off: set[str] = set()
        self._roles: list[Role] = []
        self._stack = ExitStack()
        if secure:
            self.zsim("certs", "init", self.hosts, "--scenario", str(STEP)).ends(with_code=0)

    def zsim(self, *arguments: str) -> Role:
        """Start a command where the launcher is."""
        role = Role(list(arguments), self.lab.prefix(LAUNCHER), self._env)
        self._roles.append(role)
        return role

    def up(self, *options: str) -> Role:
        """Start a run."""
        return self.zsim("up", str(STEP), "--hosts", self.hosts, "--out", str(self.out), "--no-report", *options)

    def cut(self, name: str) -> float:
        """Cut a host off; return the wall time."""
        self.lab.cut(name)
        self.cut_off.add(name)
        return time.monotonic()

    def heal(self, name: str) -> None:
        self.lab.heal(name)
        self.cut_off.discard(name)

    def ps(self) -> dict[str, dict[str, Any]]:
        """Return the rows of `zsim ps` by role."""
        role = self.zsim("ps", "--json")
        role.ends(with_code=0)
        return {row["role"]: row for row in json.loads(role.text().splitlines()[-1])["rows"]}

    def kill(self, role: str) -> None:
        """Send SIGKILL to a role."""
        for host in self.lab.names:
            for pid, line in self.lab.processes(host).items():
                if re.match(rf"\S*python\S* .*/{re.escape(role)}( |$)", line):  # its certificate's folder
                    os.kill(pid, signal.SIGKILL)
                    return
        pytest.fail(f"{role} runs on no host")

    def record(self) -> Record:
        """Return what was recorded; a record that was cut is mended first."""
        path = self.out / "run.mcap"
        repair(path)
        return Record(self._stack.enter_context(RecordReader(path)))

    def nobody_left(self) -> None:
        """Wait until no process of zsim's is on any host; fail if one stays."""
        until_s = time.monotonic() + GONE_S
        while left := {name: found for name in self.lab.names if (found := self.lab.processes(name))}:
            assert time.monotonic() < until_s, left
            threading.Event().wait(0.05)  # nothing tells of the end of another's process

    def close(self) -> None:
        for role in self._roles:
            role.close()
        self._stack.close()


@contextmanager
def closing(team: Team) -> Iterator[Team]:
    """End what a test has started, and fail if anything of it stays."""
    try:
        yield team
    finally:
        team.close()
        for name in list(team.cut_off):
            team.heal(name)
    team.nobody_left()


@pytest.fixture
def team(lab: Lab) -> Iterator[Team]:
    with closing(Team(lab, ROLES)) as made:
        yield made


@pytest.fixture
def small_disk() -> Iterator[Callable[[Path, int], None]]:
    """Give a folder a disk of its own with room for so many bytes."""
    with ExitStack() as stack:

        def mount(folder: Path, size_bytes: int) -> None:
            folder.mkdir(parents=True, exist_ok=True)
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_bytes}", "none", str(folder)], check=True)
            stack.callback(subprocess.run, ["umount", "-l", str(folder)], check=True)

        yield mount


def in_flight(run: Role) -> None:
    """Wait until simulated time goes on."""
    run.line(r"real time  (idle|taking_off|assembling|engaged)", START_S)


def in_process(folder: Path, duration_s: float) -> str:
    """Return the hash of the same flight in one process."""
    path = folder / "alone.mcap"
    fly(scenario_file.load(STEP, duration_s=duration_s), path)
    with RecordReader(path) as reader:
        return Record(reader).sha256()


def test_three_hosts_give_the_bits_of_one_process(team: Team, tmp_path: Path) -> None:
    run = team.up("--duration", "20")
    run.ends(with_code=0, within_s=START_S)
    assert team.record().sha256() == in_process(tmp_path, 20.0)
    assert {event["data"]["host"] for event in team.record().events("join")} == {"h1", "h2", "h3"}


def test_ps_logs_restart_move_and_down(team: Team) -> None:
    run = team.up("--rate", "4", "--duration", "300")
    in_flight(run)
    rows = team.ps()
    assert {role: row["host"] for role, row in rows.items()} == {
        "world": "h1",
        "recorder": "h1",
        "estimator.drone1": "h1",
        "estimator.drone2": "h2",
        "estimator.drone3": "h3",
        "controller.main": "h2",
    }
    assert all(row["state"] == "running" and row["pid"] for row in rows.values())
    team.zsim("logs", "estimator.drone3").line("estimator.drone3: in run")
    team.zsim("restart", "estimator.drone3").ends(with_code=0)
    run.line("restart: estimator.drone3 on h3|superseded: estimator.drone3 on h3", START_S)
    team.zsim("move", "estimator.drone3", "h2").ends(with_code=0)
    run.line("superseded: estimator.drone3 on h2", START_S)
    assert team.ps()["estimator.drone3"]["host"] == "h2"
    refused = team.zsim("move", "world", "h2")
    refused.ends(with_code=2)
    assert "world cannot be moved" in refused.text()
    team.zsim("down").ends(with_code=0)
    run.ends(with_code=130)
    assert "ended by zsim down" in run.text()
    assert team.record().end()["reason"] == "ended by zsim down"


def test_a_killed_launcher_leaves_nobody(team: Team) -> None:
    run = team.up("--rate", "4", "--duration", "300")
    in_flight(run)
    run.signal(signal.SIGKILL)
    team.nobody_left()


@pytest.mark.parametrize("role", ["estimator.drone2", "controller.main"])
def test_a_killed_role_is_started_again(team: Team, role: str) -> None:
    run = team.up("--rate", "8", "--duration", "30")
    in_flight(run)
    team.kill(role)
    run.line(rf"{role} .* ended: killed by signal 9; on_death: restart", START_S)
    run.ends(with_code=0, within_s=START_S)
    assert [event["subject"] for event in team.record().events("restart")] == [role]


@pytest.mark.parametrize("role", ["world", "recorder"])
def test_without_world_or_recorder_the_run_ends(team: Team, role: str) -> None:
    run = team.up("--rate", "4", "--duration", "300")
    in_flight(run)
    team.kill(role)
    run.ends(with_code=1, within_s=START_S)
    assert f"{role} " in run.text()
    assert team.record().keys()["clock"] > 10


@pytest.mark.parametrize("cut_s", [1.0, 5.0, 20.0])
def test_time_stands_still_while_a_host_is_cut_off(team: Team, tmp_path: Path, cut_s: float) -> None:
    run = team.up("--rate", "5", "--duration", "25")
    in_flight(run)
    cut_at_s = team.cut("h3")
    if cut_s > NAMED_AFTER_S:
        run.line("host h3 does not answer", START_S)
        run.line(r"waiting for estimator.drone3 on h3", START_S)
    threading.Event().wait(cut_at_s + cut_s - time.monotonic())
    team.heal("h3")
    if cut_s > NAMED_AFTER_S:
        run.line("host h3 answers again", START_S)
    run.ends(with_code=0, within_s=START_S)
    record = team.record()
    assert record.sha256() == in_process(tmp_path, 25.0)
    assert any(is_named(clock, "estimator.drone3", "h3") for clock in record.all("clock")) or cut_s < NAMED_AFTER_S


def is_named(clock: dict[str, Any], role: str, host: str) -> bool:
    """Tell whether a clock says that it waits for a role on a host."""
    return any((waiting["name"], waiting["host"]) == (role, host) for waiting in clock["waiting_for"])


def test_in_realtime_drones_land_while_their_controller_is_cut_off(team: Team) -> None:
    """The firmware's watchdog lands them; what the controller says too late is refused; the world has it all.

    world, recorder, estimator.drone1 ─── h1        h2 ─── controller.main, estimator.drone2
                                             cut 5 s
    """
    run = team.up("--realtime", "--duration", "40", "--set", "clusters.main.plan.takeoff_s=1")
    run.line("real time  (assembling|engaged)", START_S)
    team.cut("h2")
    run.line("waiting for controller.main on h2|host h2 does not answer", START_S)
    threading.Event().wait(CUT_IN_REALTIME_S)
    team.heal("h2")
    run.ends(with_code=0, within_s=40.0 + START_S)
    record = team.record()
    for drone in DRONES:
        states = [status["state"] for status in record.all(f"drone/{drone}/sensor/status")]
        assert [state for state, _ in itertools.groupby(states)][:6] == LANDED_BY_WATCHDOG
    late = [event["text"] for event in record.events("refused") if event["source"] == "controller.main"]
    assert any(re.search(r"age is \d+ ms; must be <= 500 ms", text) for text in late)
    assert {clock["step"] for clock in record.all("clock")} == set(range(40 * GATES_PER_S + 1))


def test_a_host_whose_clock_is_an_hour_off_takes_part(lab: Lab, tmp_path: Path) -> None:
    """Certificates are back-dated by a day; nothing on the wire is wall time."""
    lab.environment("h3", LD_PRELOAD=FAKETIME, FAKETIME="-1h", FAKETIME_DONT_FAKE_MONOTONIC="1")
    with closing(Team(lab, ROLES)) as team:
        run = team.up("--duration", "10")
        run.ends(with_code=0, within_s=START_S)
        assert re.search(r"warning: h3: its clock is -3[56]\d\d\.\d s off", run.text())
        assert team.record().sha256() == in_process(tmp_path, 10.0)


def test_a_killed_router_is_started_again(lab: Lab, tmp_path: Path) -> None:
    """Two hosts behind a router: what it had on the way when it died is fetched again."""
    routers = {"field": {"host": "h2"}}
    with closing(Team(lab, ROLES, routers=routers, through={"h2": "field", "h3": "field"})) as team:
        run = team.up("--rate", "8", "--duration", "30")
        in_flight(run)
        team.kill("router.field")
        run.line("router.field .* ended: killed by signal 9; on_death: restart", START_S)
        run.ends(with_code=0, within_s=START_S)
        assert team.record().sha256() == in_process(tmp_path, 30.0)


def test_a_full_disk_at_the_recorder_ends_the_run_and_keeps_the_record(
    lab: Lab, small_disk: Callable[[Path, int], None]
) -> None:
    small_disk(lab.host_folder("h3"), DISK_BYTES)
    lab.environment("h3")  # a new sshd, which sees the new disk
    with closing(Team(lab, {**ROLES, "recorder": "h3"})) as team:
        run = team.up("--duration", "300")
        run.ends(with_code=1, within_s=START_S)
        assert "No space left on device" in run.text()
        assert team.record().keys()["clock"] > 50


def test_over_a_poor_link_it_flies_in_realtime(lab: Lab) -> None:
    """50 ± 10 ms and 2 % loss each way to the host of an estimator."""
    lab.slow("h3", 50, 10, 0.02)
    with closing(Team(lab, ROLES)) as team:
        run = team.up("--realtime", "--duration", "32")
        run.ends(with_code=0, within_s=32.0 + START_S)
        record = team.record()
        assert record.all("cluster/main/state")[-1]["phase"] == "engaged"
        assert {status["state"] for drone in DRONES for status in record.all(f"drone/{drone}/sensor/status")[-50:]} == {
            "flying"
        }
        assert record.end()["command_age_ms"]["max"] > 100.0
