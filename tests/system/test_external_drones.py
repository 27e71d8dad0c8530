"""External drones: a driver that needs only zenoh and msgpack flies in a formation, dies and is restarted."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from federation import Federation, Role
from forked_commands import ROOT, USER_FAULT, refusal, run_here
from refused import has_terms
from wire import PATIENCE_S, Client, Subscription

DRONE = "drone3"
DRIVER, ARM = f"driver.{DRONE}", f"drone/{DRONE}/driver"
MIXED = """
name: mixed
seed: 3
duration_s: 300
sensors: {preset: paper, gps: {position_m: {noise: 0.1}}}
drones:
  - {name: drone1, position_m: [0, 2, 0], yaw_deg: 90}
  - {name: drone2, position_m: [-2, -2, 0], yaw_deg: 90}
  - {name: drone3, position_m: [2, -2, 0], body: external, sensors: {imu: {rate_hz: 50}}}
clusters:
  - {name: main, drones: [drone1, drone2, drone3], plan: {takeoff_s: 1, target: {z_c: 2.5}}}
"""
ALONE = """
name: alone
duration_s: 300
drones:
  - {name: drone1, position_m: [0, 0, 0]}
  - {name: drone3, position_m: [4, 0, 0], body: external}
processes: {expect: []}
"""

Start = Callable[[], subprocess.Popen[str]]


@pytest.fixture
def driver(federation: Federation) -> Iterator[Start]:
    """A function that starts the example driver; every driver is killed after the test."""
    started: list[subprocess.Popen[str]] = []

    def start() -> subprocess.Popen[str]:
        words = [
            sys.executable,
            str(ROOT / "examples/external_drone.py"),
            federation.endpoint,
            DRONE,
            "2",
            "-2",
            "0.05",
        ]
        started.append(subprocess.Popen(words, text=True, stderr=subprocess.PIPE))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def arm(client: Client, link: Subscription) -> None:
    """Request the newest driver to arm once it is connected."""
    link.until(lambda m: m["state"] == "connected")
    assert client.request(ARM, "arm", "operator.test") == {"ok": True, "error": ""}
    link.until(lambda m: m["state"] == "armed")


def stop(client: Client, role: Role) -> None:
    assert client.request("world/control", "stop")["ok"]
    role.ends(with_code=0)


@pytest.mark.parametrize("hosted", [False, pytest.param(True, marks=pytest.mark.soak)], ids=["apart", "hosted"])
def test_a_mixed_formation_survives_the_death_of_its_driver(
    federation: Federation, driver: Start, hosted: bool
) -> None:
    """While the driver is dead the formation is held and time goes on; with the next driver it engages again."""
    run = federation.run(MIXED, "--realtime", *(["--hosted"] if hosted else []))
    assert has_terms(run.line("external drones").text, DRIVER, federation.endpoint)
    client = federation.client()
    states, link, events = (
        client.subscribe(key) for key in ("cluster/main/state", f"drone/{DRONE}/link", "world/event")
    )
    clock, estimates = client.subscribe("clock"), client.subscribe(f"drone/{DRONE}/estimate")
    first = driver()
    arm(client, link)
    run.line(f"join: {DRIVER}")
    run.line(f"link of {DRONE}: armed")
    states.until(lambda m: m["phase"] == "engaged" and abs(m["value"][2] - 2.5) < 0.2)
    first.send_signal(signal.SIGKILL)
    events.until(lambda m: (m["kind"], m["subject"]) == ("death", DRIVER))
    held = states.until(lambda m: m["phase"] == "held").message
    assert has_terms(held["reason"], "estimate", DRONE, "old")
    clock.until(lambda m: m["t_ns"] > held["t_ns"] + 10**9)
    assert states.until(lambda m: m["t_ns"] > held["t_ns"] + 8 * 10**8).message["phase"] == "held"
    link.now()
    driver()
    arm(client, link)
    resumed = states.until(lambda m: m["phase"] == "engaged" and m["t_ns"] > held["t_ns"]).message
    estimates.until(lambda m: m["t_ns"] > resumed["t_ns"])
    ended = states.until(lambda m: m["t_ns"] > resumed["t_ns"] + 2 * 10**9).message
    assert ended["phase"] == "engaged"
    assert client.get(f"drone/{DRONE}/sensor/status")[f"drone/{DRONE}/sensor/status"]["state"] == "flying"
    stop(client, run)
    record = federation.record()
    accepted = record.all(f"drone/{DRONE}/accepted/velocity")
    assert [m["seq"] for m in accepted] == list(range(len(accepted)))
    assert {m["source"] for m in accepted} == {"controller.main"}
    gates = {m["t_ns"] for m in record.all("cluster/main/state") if held["t_ns"] - 10**9 < m["t_ns"] < ended["t_ns"]}
    assert len(gates) * 20_000_000 >= 0.9 * (ended["t_ns"] - held["t_ns"] + 10**9)  # time went on for the others
    assert record.sha256() == record.recomputed_sha256(["drone1", "drone2"])


def test_the_world_arbitrates_commands_to_an_external_drone(federation: Federation, driver: Start) -> None:
    """Commands from other sources than its commander, or not allowed in its state, never reach the driver."""
    world = federation.world(ALONE, "--realtime")
    client = federation.client()
    events, link = client.subscribe("world/event"), client.subscribe(f"drone/{DRONE}/link")
    accepted, status = client.subscribe(f"drone/{DRONE}/accepted/*"), client.subscribe(f"drone/{DRONE}/sensor/status")
    views, clock = client.subscribe("view/drones"), client.subscribe("clock")

    def send(kind: str, source: str, **fields: Any) -> None:
        t_ns = clock.until(lambda m: m["state"] == "running").message["t_ns"]
        clock.now()
        client.put(
            f"drone/{DRONE}/cmd/{kind}", t_ns=clock.received[-1].message["t_ns"] or t_ns, source=source, **fields
        )

    still = {"velocity_m_s": [0.3, 0.0, 0.0], "yaw_rate_rad_s": 0.0}
    send("mode", "pilot.one", mode="takeoff")
    assert "no state" in events.until(lambda m: m["kind"] == "refused").message["text"]
    driver()
    arm(client, link)
    send("velocity", "pilot.one", **still)
    assert "hovering or flying" in events.until(lambda m: m["kind"] == "refused").message["text"]
    send("mode", "pilot.one", mode="takeoff")
    assert accepted.until(lambda m: True).message["mode"] == "takeoff"
    status.until(lambda m: m["state"] == "hovering")
    send("velocity", "pilot.one", **still)
    assert accepted.until(lambda m: True).message["source"] == "pilot.one"
    send("velocity", "pilot.two", **still)
    assert "pilot.one" in events.until(lambda m: m["kind"] == "refused" and m["source"] == "pilot.two").message["text"]
    shown = views.until(lambda m: m["drones"][1]["commander"] == "pilot.one").message["drones"][1]
    assert shown["position_m"][2] > 0.8
    status.until(lambda m: m["state"] == "landing")  # by the driver, after commands have ceased
    client.put("drone/drone1/truth", t_ns=0, position_m=[0, 0, 0])
    refused = events.until(lambda m: m["kind"] == "refused" and m["subject"] == "drone/drone1/truth").message
    assert "only the world publishes here" in refused["text"]
    assert [m.message["source"] for m in accepted.now()] == ["pilot.one"] * 2
    stop(client, world)


def test_a_run_waits_for_an_expected_driver(federation: Federation, driver: Start) -> None:
    run = federation.run(ALONE.replace("expect: []", f"expect: [{DRIVER}]"), "--realtime")
    assert "the run waits for driver.drone3" in run.line("external drones").text
    run.line(f"waiting for .*{DRIVER}")
    client = federation.client()
    link = client.subscribe(f"drone/{DRONE}/link")
    process = driver()
    assert link.until(lambda m: m["t_ns"] > 0).message["source"] == DRIVER
    stop(client, run)
    assert process.wait(PATIENCE_S) == 0
    assert os.path.exists(federation.out / "run.mcap")


@pytest.mark.parametrize("options", [(), ("--in-process",), ("--rate", "1")])
def test_lockstep_is_refused_before_anything_starts(federation: Federation, options: tuple[str, ...]) -> None:
    path = federation.write(ALONE)
    line = refusal("run", path, "--out", str(federation.out), *options)
    assert has_terms(line, "alone", DRONE, "external", "lockstep", "--realtime")
    assert not federation.out.exists()


def test_a_world_and_a_sweep_refuse_lockstep(federation: Federation) -> None:
    path = federation.write(ALONE)
    assert has_terms(refusal("world", path, "--listen", federation.endpoint), DRONE, "external", "lockstep")
    swept = run_here("sweep", path, "--runs", "2")
    assert swept.code == USER_FAULT
    assert has_terms(swept.stderr, DRONE, "external", "lockstep")
