"""A gateway in a federation with TLS and access control: its rights, and sessions with their own certificates."""

from pathlib import Path

import pytest
from federation import PAIR, Federation
from gateway_process import GatewayProcess
from refused import has_terms
from secured import Certificates, tls_endpoint

from zsim.scenario import scenario_file
from zsim_deploy.certificates import access_control

IN_LOCKSTEP = PAIR.replace("clusters:", "processes: {expect: [matlab.main]}\nclusters:").replace(
    "duration_s: 12", "duration_s: 2"
)
STATUSES = ["drone/drone1/sensor/status", "drone/drone2/sensor/status"]
GATE_NS = 20_000_000


@pytest.fixture
def gateway(federation: Federation, tmp_path: Path) -> GatewayProcess:
    """A gateway that joins as an operator, with the certificate of one session in its folder."""
    made = Certificates(tmp_path / "certs")
    rules = access_control(scenario_file.from_text(IN_LOCKSTEP), ["operator.gate", "matlab.main"], {})
    world = made.identity("world", rules)
    federation.endpoint = tls_endpoint()
    federation.world(IN_LOCKSTEP, "--tls", str(world.tls), "--access", str(world.access))
    made.of("matlab.main")
    return GatewayProcess(federation, "--tls", str(made.of("operator.gate"))).in_run()


def test_the_gateway_reads_and_commands_as_an_operator(gateway: GatewayProcess):
    gateway.role.line("^operator.gate: ")
    assert gateway.http("GET", "/json/clock").json()["state"] == "waiting"
    assert [entry["key"] for entry in gateway.http("GET", "/zsim/clock").json()] == ["zsim/clock"]
    refused = gateway.http("PUT", "/json/my/key", 1)
    assert refused.status == 403
    assert has_terms(refused.json()["error"], "my/key", "certificate", "drone/*/cmd/*")
    assert gateway.http("POST", "/json/world/control", {"op": "stop"}).json()["ok"]


def test_a_session_joins_with_its_own_certificate(gateway: GatewayProcess):
    with gateway.connect() as stream:
        assert stream.request("join", name="matlab.main", period_s=0.02, reads=STATUSES)["op"] == "join"
        gate = stream.next("gate", "left")
        assert [entry["key"] for entry in gate["inputs"]] == STATUSES
        takeoff = [{"key": "drone/drone1/cmd/mode", "value": {"mode": "takeoff"}}]
        stream.send("done", t_ns=gate["t_ns"], outputs=takeoff)
        seen = set()
        while (gate := stream.next("gate", "left"))["op"] == "gate":
            seen |= {entry["value"]["state"] for entry in gate["inputs"]}
            stream.send("done", t_ns=gate["t_ns"])
        assert "ended" in gate["reason"]
        assert "taking_off" in seen


def test_a_session_without_a_certificate_is_refused(gateway: GatewayProcess):
    with gateway.connect() as stream:
        stream.request("join", name="other", period_s=0.02, reads=STATUSES)
        reason = stream.next("left")["reason"]
        assert has_terms(reason, "client.other: ", "certificate")
        assert stream.request("join", name="matlab.main", period_s=0.02, reads=STATUSES)["op"] == "join"
