"""`zsim up` on three real hosts: the same bits as in one process, over TLS with access control, whatever fails."""

import errno
import itertools
import os
import re
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import namespaces
import pytest
from deployment import DISK_BYTES, NAMED_AFTER_S, ROLES, START_S, Deployment, closing, in_flight, in_process
from lab import Lab

DRONES = ("drone1", "drone2", "drone3")
FLIGHT_S = 15.0  # simulated, of Test 1
GATES_PER_S = 50  # of Test 1
CUT_IN_REALTIME_S = 5.0  # longer than the firmware's patience (0.5 s until it hovers, 2 s more until it lands)


@pytest.mark.soak  # with a cut in it, below
def test_three_hosts_give_the_bits_of_one_process(deployment: Deployment, tmp_path: Path) -> None:
    run = deployment.up("--duration", "20")
    run.ends(with_code=0, within_s=START_S)
    assert deployment.record().sha256() == in_process(tmp_path, 20.0)
    assert {event["data"]["host"] for event in deployment.record().events("join")} == {"h1", "h2", "h3"}


def test_ps_logs_restart_move_and_down(deployment: Deployment, tmp_path: Path) -> None:
    """Who is restarted, or moved to another host, goes on from its snapshot: the bits are those of a quiet run."""
    run = deployment.up("--rate", "1", "--duration", "3600")
    in_flight(run)
    rows = deployment.ps()
    assert {role: row["host"] for role, row in rows.items()} == {
        "world": "h1",
        "recorder": "h1",
        "estimator.drone1": "h1",
        "estimator.drone2": "h2",
        "estimator.drone3": "h3",
        "controller.main": "h2",
    }
    assert all(row["pid"] for row in rows.values())
    deployment.zsim("logs", "estimator.drone3").line("estimator.drone3: in run")
    for role, named in (("estimator.drone3", "silent: estimator.drone3 on h3"), ("world", "world .* no sign of life")):
        deployment.kill(role, signal.SIGSTOP)
        run.line(named, START_S)
        states = {each: row["state"] for each, row in deployment.ps().items()}
        assert [each for each, state in states.items() if "no sign of life" in state] == [role]
        assert role == "world" or states["controller.main"] == f"waits for {role}"
        deployment.kill(role, signal.SIGCONT)
        run.line(f"{role} .*is back", START_S)
    deployment.zsim("restart", "estimator.drone3").ends(with_code=0)
    run.line("restart: estimator.drone3 on h3|superseded: estimator.drone3 on h3", START_S)
    deployment.zsim("move", "estimator.drone3", "h2").ends(with_code=0)
    run.line("superseded: estimator.drone3 on h2", START_S)
    assert deployment.ps()["estimator.drone3"]["host"] == "h2"
    refused = deployment.zsim("move", "world", "h2")
    refused.ends(with_code=2)
    assert re.match("(h1: )?world ", refused.text())
    deployment.zsim("down").ends(with_code=0)
    run.ends(with_code=130)
    record = deployment.record()
    reason = record.end()["reason"]
    assert "zsim down" in reason
    assert reason in run.text()
    assert record.sha256() == in_process(tmp_path, record.end()["last_ns"] / 1e9)


@pytest.mark.soak  # what a broken session does to more of them at once is below
@pytest.mark.parametrize("role", ["estimator.drone2", "controller.main", "recorder"])
def test_a_killed_role_is_started_again(deployment: Deployment, tmp_path: Path, role: str) -> None:
    run = deployment.up("--rate", "8", "--duration", "30")
    in_flight(run)
    deployment.kill(role)
    run.line(rf"{role} .* ended: killed by signal 9; on_death: restart", START_S)
    run.ends(with_code=0, within_s=START_S)
    assert deployment.record().sha256() == in_process(tmp_path, 30.0)
    assert [event["subject"] for event in deployment.record().events("restart")] == [role]


@pytest.mark.soak
def test_a_broken_ssh_session_is_the_death_of_its_roles(deployment: Deployment) -> None:
    """They end, since their launcher is gone; time stands still until there are new ones."""
    run = deployment.up("--rate", "4", "--duration", "3600")
    in_flight(run)
    for pid, line in namespaces.members(deployment.lab.namespace("h2")):
        if re.match(r"sshd(-session)?: \w+@notty", line):
            os.kill(pid, signal.SIGKILL)
    run.line(r"controller.main .* ended: .*connection to h2 broke.*; on_death: restart", START_S)
    for role in ("controller.main", "estimator.drone2"):
        run.line(f"(restart|superseded): {role} on h2", START_S)
    run.signal(signal.SIGINT)
    run.ends(with_code=130, within_s=START_S)
    record = deployment.record()
    assert {event["subject"] for event in record.events("death")} == {"controller.main", "estimator.drone2"}


@pytest.mark.soak  # test_kill has it on one host
def test_the_death_of_the_world_costs_no_bit(deployment: Deployment, tmp_path: Path) -> None:
    run = deployment.up("--rate", "8", "--duration", "30")
    in_flight(run)
    deployment.kill("world")
    run.line(r"world .* ended: killed by signal 9; on_death: restart", START_S)
    run.line("world: goes on at t = ", START_S)
    run.ends(with_code=0, within_s=START_S)
    record = deployment.record()
    assert record.sha256() == record.recomputed_sha256(["drone1", "drone2", "drone3"]) == in_process(tmp_path, 30.0)
    assert record.events("death") == []


@pytest.mark.parametrize("cut_s", [1.0, *(pytest.param(cut_s, marks=pytest.mark.soak) for cut_s in (5.0, 20.0))])
def test_time_stands_still_while_a_host_is_cut_off(deployment: Deployment, tmp_path: Path, cut_s: float) -> None:
    run = deployment.up("--rate", "5", "--duration", f"{FLIGHT_S:g}")
    in_flight(run)
    cut_at_s = deployment.cut("h3")
    if cut_s > NAMED_AFTER_S:
        run.line("host h3 does not answer", START_S)
        run.line(r"waiting for estimator.drone3 on h3", START_S)
    threading.Event().wait(cut_at_s + cut_s - time.monotonic())
    deployment.heal("h3")
    if cut_s > NAMED_AFTER_S:
        run.line("host h3 answers again", START_S)
    run.ends(with_code=0, within_s=START_S)
    record = deployment.record()
    assert record.sha256() == in_process(tmp_path, FLIGHT_S)
    assert {event["data"]["host"] for event in record.events("join")} == {"h1", "h2", "h3"}
    assert any(is_named(clock, "estimator.drone3", "h3") for clock in record.all("clock")) or cut_s < NAMED_AFTER_S


def is_named(clock: dict[str, Any], role: str, host: str) -> bool:
    """Tell whether a clock says that it waits for a role on a host."""
    return any((waiting["name"], waiting["host"]) == (role, host) for waiting in clock["waiting_for"])


@pytest.mark.soak
def test_in_realtime_drones_land_while_their_controller_is_cut_off(deployment: Deployment) -> None:
    """The firmware's watchdog lands them; what the controller says too late is refused; the world has it all.

    world, recorder, estimator.drone1 ─── h1        h2 ─── controller.main, estimator.drone2
                                             cut 5 s
    """
    run = deployment.up("--realtime", "--duration", "28", "--set", "clusters.main.plan.takeoff_s=1")
    run.line("real time  (assembling|engaged)", START_S)
    cut_at_s = deployment.cut("h2")
    run.line("waiting for controller.main on h2|host h2 does not answer", START_S)
    threading.Event().wait(cut_at_s + CUT_IN_REALTIME_S - time.monotonic())
    deployment.heal("h2")
    run.ends(with_code=0, within_s=28.0 + START_S)
    record = deployment.record()
    for drone in DRONES:
        states = [status["state"] for status in record.all(f"drone/{drone}/sensor/status")]
        assert ("hovering", "landing") in itertools.pairwise(states)
    late = [event["text"] for event in record.events("refused") if event["source"] == "controller.main"]
    assert any(re.search(r"age is \d+ ms; .*500 ms", text) for text in late)
    steps = {clock["step"] for clock in record.all("clock")}
    assert steps == set(range(max(steps) + 1))
    assert max(steps) > 24 * GATES_PER_S


@pytest.mark.soak
def test_a_host_whose_clock_is_an_hour_off_takes_part(lab: Lab, faketime: str, tmp_path: Path) -> None:
    """Certificates are back-dated by a day; nothing on the wire is wall time."""
    lab.environment("h3", LD_PRELOAD=faketime, FAKETIME="-1h", FAKETIME_DONT_FAKE_MONOTONIC="1")
    with closing(Deployment(lab, ROLES)) as deployment:
        run = deployment.up("--duration", "10")
        run.ends(with_code=0, within_s=START_S)
        assert re.search(r"warning: h3: its clock is -3[56]\d\d\.\d s off", run.text())
        assert deployment.record().sha256() == in_process(tmp_path, 10.0)


@pytest.mark.soak
def test_a_host_that_computes_otherwise_is_warned_of_and_shown(lab: Lab, tmp_path: Path) -> None:
    """To the processes of one host another version of a numeric package seems to be installed."""
    other = tmp_path / "filterpy-99.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: filterpy\nVersion: 99\n")
    lab.environment("h3", PYTHONPATH=str(tmp_path))
    with closing(Deployment(lab, ROLES)) as deployment:
        run = deployment.up("--duration", "4")
        run.ends(with_code=0, within_s=START_S)
        (event,) = deployment.record().events("fingerprint")
        assert event["subject"] == "estimator.drone3"
        assert event["text"] in run.text()
        assert re.search("^warning: .*fingerprint", run.text(), re.MULTILINE)


@pytest.mark.soak
def test_a_killed_router_is_started_again(lab: Lab, tmp_path: Path) -> None:
    """Two hosts behind a router: what it had on the way when it died is fetched again."""
    routers = {"field": {"host": "h2"}}
    with closing(Deployment(lab, ROLES, routers=routers, through={"h2": "field", "h3": "field"})) as deployment:
        run = deployment.up("--rate", "8", "--duration", "30")
        in_flight(run)
        deployment.kill("router.field")
        run.line("router.field .* ended: killed by signal 9; on_death: restart", START_S)
        run.ends(with_code=0, within_s=START_S)
        assert deployment.record().sha256() == in_process(tmp_path, 30.0)


@pytest.mark.soak
def test_a_router_per_site_each_at_the_world(lab: Lab, tmp_path: Path) -> None:
    """What an estimator of one site says reaches the controller of the other through the world.

    estimator.drone2, controller.main ─── router.a ─── world ─── router.b ─── estimator.drone3
    """
    routers = {"a": {"host": "h2"}, "b": {"host": "h3"}}
    with closing(Deployment(lab, ROLES, routers=routers, through={"h2": "a", "h3": "b"})) as deployment:
        run = deployment.up("--duration", "10")
        run.ends(with_code=0, within_s=START_S)
        assert deployment.record().sha256() == in_process(tmp_path, 10.0)


@pytest.mark.soak
def test_a_full_disk_at_the_recorder_ends_the_run_and_keeps_the_record(
    lab: Lab, small_disk: Callable[[Path, int], None]
) -> None:
    small_disk(lab.host_folder("h3"), DISK_BYTES)
    lab.environment("h3")  # a new sshd, which sees the new disk
    with closing(Deployment(lab, {**ROLES, "recorder": "h3"})) as deployment:
        run = deployment.up("--duration", "3600")
        run.ends(with_code=1, within_s=START_S)
        assert os.strerror(errno.ENOSPC) in run.text()
        assert deployment.record().keys()["clock"] > 0


@pytest.mark.soak
def test_over_a_poor_link_it_flies_in_realtime(lab: Lab) -> None:
    """50 ± 10 ms and 2 % loss each way to the host of an estimator."""
    lab.slow("h3", 50, 10, 0.02)
    with closing(Deployment(lab, ROLES)) as deployment:
        run = deployment.up("--realtime", "--duration", "18", "--set", "clusters.main.plan.takeoff_s=2")
        run.ends(with_code=0, within_s=18.0 + START_S)
        record = deployment.record()
        assert record.all("cluster/main/state")[-1]["phase"] == "engaged"
        for drone in DRONES:
            assert record.all(f"drone/{drone}/sensor/status")[-1]["state"] in ("flying", "hovering")
        assert record.end()["command_age_ms"]["max"] > 100.0
