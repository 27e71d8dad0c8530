"""Realtime runs: paced by the wall clock, with no waiting, and with every delay counted."""

import os
import signal
import time

import pytest
from federation import ONE, PAIR, PAIR_ROLES, Federation, Role
from refused import parts
from wire import Client

FOR_LONG = ("--duration", "3600")
SLOW = 0.02  # rate at which 500 ms of simulated time take 25 s of wall time
NOBODY_FLIES = "processes.on_death={controller: drop}"
GATE_NS = 20_000_000


def stop(client: Client, role: Role, code: int = 0) -> None:
    """End a run by request; its exit code is 1 if it has left its plan."""
    assert client.request("world/control", "stop")["ok"]
    role.ends(with_code=code)


@pytest.mark.parametrize("rate", [1, pytest.param(5, marks=pytest.mark.soak)])
def test_a_realtime_run_keeps_pace(federation: Federation, rate: int) -> None:
    duration_s = 3 * rate
    run = federation.run(PAIR, "--realtime", "--rate", str(rate), "--duration", str(duration_s))
    run.ends(with_code=0)
    record = federation.record()
    end = record.end()
    assert end["last_ns"] == duration_s * 10**9
    # A loaded machine may be late by any amount, but nothing may be early, and delays must be measured and reported.
    assert end["wall_s"] > 0.99 * duration_s / rate
    assert end["deadlines"] >= 3 * (duration_s * 50 - 3)
    assert 0 <= end["deadline_misses"] <= end["deadlines"] + duration_s * 50
    assert end["deadline_misses"] == sum(end["deadline_misses_by"].values())
    assert set(end["deadline_misses_by"]) == {*PAIR_ROLES, "world"}
    if rate == 5:  # the other run ends before the flight begins at 4 s
        age = end["command_age_ms"]
        assert 0 < age["p50"] <= age["p99"] <= age["max"]
    assert all(clock["waiting_for"] == [] for clock in record.all("clock") if clock["state"] == "running")


def test_a_stopped_participant_is_not_waited_for(federation: Federation) -> None:
    """A stopped estimator holds up neither time nor its controller, and misses a deadline at every gate."""
    run = federation.run(PAIR, "--realtime", "--rate", "2", *FOR_LONG)
    client = federation.client()
    clock, states = client.subscribe("clock"), client.subscribe("cluster/main/state")
    clock.until(lambda m: m["t_ns"] > 2e9)
    federation.kill("estimator.drone1", signal.SIGSTOP)
    stopped_ns = client.get("clock")["clock"]["t_ns"]
    clock.until(lambda m: m["t_ns"] > stopped_ns + 4e9)
    assert states.until(lambda m: m["t_ns"] > stopped_ns + 3e9).message["reason"]
    federation.kill("estimator.drone1", signal.SIGCONT)
    stop(client, run)
    end = federation.record().end()
    assert end["deadline_misses_by"]["estimator.drone1"] >= 150  # out of the 200 gates while it was stopped


def test_a_frozen_run_continues_where_it_stopped(federation: Federation) -> None:
    """As when a machine is suspended; lost time is not made up in a burst that nothing could follow or record."""
    rate, duration_s, frozen_s = 2, 14, 3.0
    run = federation.run(PAIR, "--realtime", "--rate", str(rate), "--duration", str(duration_s))
    federation.client().subscribe("clock").until(lambda m: m["t_ns"] > 2e9)
    pids = {run.process.pid, *(pid for pid, _ in federation._processes())}
    for number in (signal.SIGSTOP, signal.SIGCONT):
        for pid in pids:
            os.kill(pid, number)
        time.sleep(frozen_s if number == signal.SIGSTOP else 0.0)
    run.ends(with_code=0)
    run.line(r"standstill: time stood still for \d")
    record = federation.record()
    (event,) = record.events("standstill")
    assert event["data"]["wall_s"] > 0.9 * frozen_s
    gates = [clock["t_ns"] for clock in record.all("clock") if clock["state"] == "running"]
    assert gates == list(range(0, duration_s * 10**9 + 1, GATE_NS))
    assert record.end()["wall_s"] > 0.99 * (duration_s / rate + frozen_s)


def test_drones_hover_after_their_controller_dies(federation: Federation) -> None:
    """A dead controller loses its drones, and a drone without a commander hovers."""
    run = federation.run(PAIR, "--realtime", "--rate", "3", *FOR_LONG, "--set", NOBODY_FLIES)
    client = federation.client()
    events, states = client.subscribe("world/event"), client.subscribe("drone/drone1/sensor/status")
    flown_ns = states.until(lambda m: m["state"] == "flying").message["t_ns"]
    federation.kill("controller.main")
    events.until(lambda m: (m["kind"], m["subject"]) == ("release", "drone1"))
    events.until(lambda m: (m["kind"], m["subject"]) == ("drop", "controller.main"))
    states.until(lambda m: m["state"] == "hovering" and m["t_ns"] > flown_ns)
    stop(client, run)
    seen = [received.message["state"] for received in states.now() if received.message["t_ns"] >= flown_ns]
    assert list(dict.fromkeys(seen)) == ["flying", "hovering"]


def test_drones_hover_then_land_under_a_silent_commander(federation: Federation) -> None:
    """A hung controller keeps its drones, so the firmware's watchdog lands them."""
    run = federation.run(PAIR, "--realtime", "--rate", "3", *FOR_LONG)
    client = federation.client()
    states = client.subscribe("drone/drone1/sensor/status")
    states.until(lambda m: m["state"] == "flying" and m["t_ns"] > 6e9)
    federation.kill("controller.main", signal.SIGSTOP)
    states.until(lambda m: m["state"] == "hovering")
    landing = states.until(lambda m: m["state"] == "landing")
    states.until(lambda m: m["state"] == "landed")
    federation.kill("controller.main", signal.SIGCONT)
    stop(client, run, code=1)
    flown_ns = max(h.message["t_ns"] for h in states.received if h.message["state"] == "flying")
    hovering_ns = next(h.message["t_ns"] for h in states.received if h.message["t_ns"] > flown_ns)
    assert landing.message["t_ns"] - hovering_ns == pytest.approx(2e9, abs=GATE_NS)


def test_commands_older_than_500_ms_are_refused(federation: Federation) -> None:
    world = federation.world(ONE, "--realtime", "--rate", "1", *FOR_LONG)
    client = federation.client()
    clock, events = client.subscribe("clock"), client.subscribe("world/event")
    clock.until(lambda m: m["t_ns"] > 1e9)
    client.put("drone/drone1/cmd/mode", t_ns=0, source="tester.old", mode="takeoff")
    refused = events.until(lambda m: m["kind"] == "refused")
    assert refused.message["source"] == "tester.old"
    assert "500 ms" in refused.message["data"]["reason"]
    assert client.request("world/control", "rate", value=SLOW)["ok"]
    now_ns = client.get("clock")["clock"]["t_ns"]
    client.put("drone/drone1/cmd/mode", t_ns=now_ns, source="tester.new", mode="takeoff")
    assert client.request("world/control", "rate", value=5)["ok"]
    assert events.until(lambda m: m["kind"] == "mode").message["source"] == "tester.new"
    stop(client, world)


def test_a_realtime_run_can_be_paused_stepped_and_resumed(federation: Federation) -> None:
    world = federation.world(ONE, "--realtime", "--rate", "5", "--duration", "1000")
    client = federation.client()
    clock = client.subscribe("clock")
    clock.until(lambda m: m["t_ns"] > 1e9)
    assert client.request("world/control", "pause")["ok"]
    first = clock.until(lambda m: m["state"] == "paused")
    later = clock.until(lambda m: m["state"] == "paused")
    assert later.message["t_ns"] == first.message["t_ns"]
    assert client.request("world/control", "step", gates=3)["ok"]
    clock.until(lambda m: m["state"] == "paused" and m["t_ns"] == first.message["t_ns"] + 3 * GATE_NS)
    assert client.request("world/control", "resume")["ok"]
    resumed = clock.until(lambda m: m["state"] == "running")
    assert parts(client.request("world/control", "rate", value=0)["error"]) == ("value", "0")
    assert client.request("world/control", "rate", value=50)["ok"]
    clock.until(lambda m: m["t_ns"] >= resumed.message["t_ns"] + 20e9)
    stop(client, world)
