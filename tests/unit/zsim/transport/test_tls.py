"""Endpoints that leave the machine, and the permissions that are reported to a process."""

import pytest
from refused import has_terms
from rights_table import KEYS, ROLES, SCENARIO, keys_of

from zsim.contract import keys, messages
from zsim.scenario import scenario_file
from zsim.transport.tls import Act, Permissions, leaves_machine, permissions_of
from zsim_deploy.certificates import access_control

LOCAL = ("tcp/127.0.0.1:7447", "tcp/127.1.2.3:7447", "tcp/[::1]:7447", "ws/localhost:80", "unixsock-stream//tmp/z")
OUT = ("tcp/0.0.0.0:7447", "tcp/[::]:7447", "udp/192.0.2.1:7447", "ws/lab-pc:80", "tcp/localhost.example:1")


@pytest.mark.parametrize("endpoint", [*LOCAL, *OUT])
def test_only_endpoints_reachable_from_outside_leave_the_machine(endpoint: str):
    assert leaves_machine(endpoint) == (endpoint in OUT)


# The permissions reported to a process are those that access control grants


ACTS: dict[Act, str] = {"publish": "p", "read": "r", "ask": "g"}
RULES = access_control(scenario_file.from_text(SCENARIO), ROLES, {"router.site": ["estimator.drone2"]})


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("act", ACTS)
def test_the_permissions_of_a_role_match_the_table(role: str, act: Act) -> None:
    answer = messages.encode(permissions_of(RULES, "world", role))
    found = messages.decode_as(Permissions, answer, keys.access(role))
    assert found.refusal() is None
    allowed = {key for key in KEYS if any(keys.matches(each, f"zsim/{key}") for each in found.allowed[act])}
    assert allowed == keys_of(role, ACTS[act])


@pytest.mark.parametrize("name", ["operator.eve", "anyone", "estimator.drone2"])
def test_a_process_that_no_rule_names_is_refused(name: str) -> None:
    refusal = permissions_of(RULES, "world", name).refusal()
    assert has_terms(refusal, name, "world", *ROLES[:4], str(len(ROLES) - 3), "zsim certs init", "world")


def test_a_denial_names_the_most_similar_key_first() -> None:
    line = permissions_of(RULES, "world", "estimator.drone1").denial("publish", "drone/drone2/estimate", "zsim/")
    assert has_terms(line, "estimator.drone1", "publish", "drone/drone2/estimate", "drone/drone1/estimate", "3")


def test_a_deny_or_egress_rule_allows_nothing() -> None:
    rule = {"id": "a", "permission": "deny", "messages": ["put"], "key_exprs": ["zsim/**"]}
    others = {"subjects": [{"id": "s", "cert_common_names": ["x"]}], "policies": [{"subjects": ["s"], "rules": ["a"]}]}
    assert permissions_of({"rules": [rule], **others}, "world", "x").refusal()
    outwards = {**rule, "permission": "allow", "flows": ["egress"]}
    assert permissions_of({"rules": [outwards], **others}, "world", "x").refusal()
    both_ways = {**rule, "permission": "allow"}
    assert permissions_of({"rules": [both_ways], **others}, "world", "x").allowed["publish"] == ("zsim/**",)
