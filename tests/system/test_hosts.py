"""`zsim up` on three hosts over TLS with access control gives the bits of one process despite failures."""

import itertools
import os
import re
import signal
import threading
import time
from pathlib import Path

import namespaces
import pytest
from deployment import ROLES, START_S, Deployment, closing, in_flight, in_process
from lab import Lab

DRONES = ("drone1", "drone2", "drone3")
FLIGHT_S = 15.0  # simulated part of Test 1
GATES_PER_S = 50  # as in Test 1
TAKEOFF = "clusters.main.plan.takeoff_s=1"  # early, so that the drones fly during the test
CUT_S = 1.0  # shorter than the time after which a silent host is reported
CUT_IN_REALTIME_S = 5.0  # longer than the firmware waits (0.5 s until it hovers, 2 s more until it lands)


def test_ps_logs_restart_move_and_down_leave_the_bits_unchanged(deployment: Deployment, tmp_path: Path) -> None:
    """Processes that are stopped, restarted, moved or cut off continue with the bits of an undisturbed run."""
    run = deployment.up("--rate", "0.5", "--duration", "3600", "--set", TAKEOFF)
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
    assert "estimator.drone3: in run" in deployment.here("logs", "estimator.drone3")
    for role, named in (("estimator.drone3", "silent: estimator.drone3 on h3"), ("world", "world .* no sign of life")):
        deployment.kill(role, signal.SIGSTOP)
        run.line(named, START_S)
        deployment.until_states(
            lambda states, role=role: (
                [each for each, state in states.items() if "no sign of life" in state] == [role]
                and (role == "world" or states["controller.main"] == f"waits for {role}")
            )
        )
        deployment.kill(role, signal.SIGCONT)
        run.line(f"{role} .*is back", START_S)
    deployment.here("restart", "estimator.drone3")
    run.line("restart: estimator.drone3 on h3|superseded: estimator.drone3 on h3", START_S)
    cut_at_s = deployment.cut("h3")
    threading.Event().wait(cut_at_s + CUT_S - time.monotonic())
    deployment.heal("h3")
    deployment.here("move", "estimator.drone3", "h2")
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
    assert record.sha256() == in_process(tmp_path, record.end()["last_ns"] / 1e9, [TAKEOFF])


@pytest.mark.soak
def test_a_broken_ssh_session_counts_as_the_death_of_its_roles(deployment: Deployment) -> None:
    """The roles end, since they have lost their launcher; time stops until they are restarted."""
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


@pytest.mark.soak
def test_in_realtime_drones_land_while_their_controller_is_cut_off(deployment: Deployment) -> None:
    """The firmware's watchdog lands them; late commands of the controller are refused; the record has every gate.

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
def test_a_host_with_a_different_fingerprint_is_reported(lab: Lab, tmp_path: Path) -> None:
    """The processes of one host compute their fingerprint from only part of the code."""
    less = "from zsim.contract import fingerprint\nfingerprint.CODE = fingerprint.CODE[:1]\n"
    (tmp_path / "sitecustomize.py").write_text(less)
    lab.environment("h3", PYTHONPATH=str(tmp_path))
    with closing(Deployment(lab, ROLES)) as deployment:
        run = deployment.up("--duration", "4")
        run.ends(with_code=0, within_s=START_S)
        (event,) = deployment.record().events("fingerprint")
        assert event["subject"] == "estimator.drone3"
        assert event["text"] in run.text()
        assert re.search("^warning: .*fingerprint", run.text(), re.MULTILINE)


@pytest.mark.soak
def test_sites_with_a_router_each_communicate_through_the_world(lab: Lab, tmp_path: Path) -> None:
    """Estimates from one site reach the controller at the other through the world.

    estimator.drone2, controller.main ─── router.a ─── world ─── router.b ─── estimator.drone3
    """
    routers = {"a": {"host": "h2"}, "b": {"host": "h3"}}
    with closing(Deployment(lab, ROLES, routers=routers, through={"h2": "a", "h3": "b"})) as deployment:
        run = deployment.up("--duration", "10")
        run.ends(with_code=0, within_s=START_S)
        assert deployment.record().sha256() == in_process(tmp_path, 10.0)


@pytest.mark.soak
def test_a_formation_flies_in_realtime_over_a_poor_link(lab: Lab) -> None:
    """The link to the host of an estimator has 50 ± 10 ms delay and 2 % loss in each direction."""
    lab.slow("h3", 50, 10, 0.02)
    with closing(Deployment(lab, ROLES)) as deployment:
        run = deployment.up("--realtime", "--duration", "18", "--set", "clusters.main.plan.takeoff_s=2")
        run.ends(with_code=0, within_s=18.0 + START_S)
        record = deployment.record()
        assert record.all("cluster/main/state")[-1]["phase"] == "engaged"
        for drone in DRONES:
            assert record.all(f"drone/{drone}/sensor/status")[-1]["state"] in ("flying", "hovering")
        assert record.end()["command_age_ms"]["max"] > 100.0
