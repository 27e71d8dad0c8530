"""A gateway in a federation with TLS and access control: what it may do, and seats with certificates of their own."""

from pathlib import Path

import pytest
from door import Door
from federation import PAIR, Federation
from secured import Certificates, tls_endpoint

from zsim.scenario import scenario_file
from zsim_deploy.inventory.enrolment import access_control

SEATED = PAIR.replace("clusters:", "processes: {expect: [matlab.main]}\nclusters:").replace(
    "duration_s: 12", "duration_s: 2"
)
STATUSES = ["drone/drone1/sensor/status", "drone/drone2/sensor/status"]
GATE_NS = 20_000_000


@pytest.fixture
def door(federation: Federation, tmp_path: Path) -> Door:
    """A gateway that comes in as an operator; in its folder lies the certificate of one seat."""
    made = Certificates(tmp_path / "certs")
    rules = access_control(scenario_file.from_text(SEATED), ["operator.gate", "matlab.main"], {})
    world = made.identity("world", rules)
    federation.endpoint = tls_endpoint()
    federation.world(SEATED, "--tls", str(world.tls), "--access", str(world.access))
    made.of("matlab.main")
    return Door(federation, "--tls", str(made.of("operator.gate"))).in_run()


def test_it_reads_and_commands_as_an_operator(door: Door):
    assert "operator.gate: clients are let into run" in door.role.text()
    assert door.http("GET", "/json/clock").json()["state"] == "waiting"
    assert [entry["key"] for entry in door.http("GET", "/zsim/clock").json()] == ["zsim/clock"]
    refused = door.http("PUT", "/json/my/key", 1)
    assert refused.status == 403
    assert "the gateway's certificate lets it speak on" in refused.json()["error"]
    assert "drone/*/cmd/*" in refused.json()["error"]
    assert door.http("POST", "/json/world/control", {"op": "stop"}).json()["ok"]


def test_a_seat_comes_in_by_its_own_certificate(door: Door):
    with door.stream() as stream:
        assert stream.ask("join", name="matlab.main", period_s=0.02, reads=STATUSES)["op"] == "join"
        gate = stream.next("gate", "left")
        assert [entry["key"] for entry in gate["inputs"]] == STATUSES
        takeoff = [{"key": "drone/drone1/cmd/mode", "value": {"mode": "takeoff"}}]
        stream.tell("done", t_ns=gate["t_ns"], outputs=takeoff)
        seen = set()
        while (gate := stream.next("gate", "left"))["op"] == "gate":
            seen |= {entry["value"]["state"] for entry in gate["inputs"]}
            stream.tell("done", t_ns=gate["t_ns"])
        assert gate["reason"] == "the run ended"
        assert "taking_off" in seen


def test_a_seat_without_a_certificate_is_told(door: Door):
    with door.stream() as stream:
        stream.ask("join", name="other", period_s=0.02, reads=STATUSES)
        reason = stream.next("left")["reason"]
        assert reason.startswith("client.other: has no certificate here")
        assert stream.ask("join", name="matlab.main", period_s=0.02, reads=STATUSES)["op"] == "join"
