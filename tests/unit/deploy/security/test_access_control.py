"""Rights of roles and the access control made of them, against the table written by hand."""

import json
from typing import Any

import pytest
import zenoh
from rights_table import KEYS, ROLES, SCENARIO, keys_of

from zsim.scenario import rights, scenario_file
from zsim_deploy.security.access_control import access_control

ACTS = {"r": "reads", "p": "writes", "g": "asks", "a": "answers", "t": "tokens", "w": "watches"}
# What each act is on the wire at the process that listens: (flow, message); all of them are needed.
WIRE = {
    "r": (("ingress", "declare_subscriber"), ("egress", "put")),
    "p": (("ingress", "put"), ("egress", "declare_subscriber")),
    "g": (("ingress", "query"), ("egress", "reply")),
    "a": (("ingress", "declare_queryable"), ("egress", "query"), ("ingress", "reply")),
    "t": (("ingress", "liveliness_token"),),
    "w": (
        ("ingress", "liveliness_query"),
        ("ingress", "declare_liveliness_subscriber"),
        ("egress", "liveliness_token"),
    ),
}
TOKENS = tuple(key for key in KEYS if key.startswith("process/") and key.count("/") == 1)


@pytest.fixture(scope="module")
def scenario() -> Any:
    return scenario_file.from_text(SCENARIO)


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("act", ACTS)
def test_the_rights_of_a_role_are_those_of_the_table(scenario: Any, role: str, act: str) -> None:
    expressions = getattr(rights.of(role, scenario), ACTS[act])
    asked = TOKENS if act in "tw" else KEYS
    assert {key for key in asked if rights.permits(expressions, key)} == keys_of(role, act)


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("act", ACTS)
def test_zenoh_is_told_what_the_table_says(scenario: Any, role: str, act: str) -> None:
    rules = access_control(scenario, ROLES, {})
    asked = TOKENS if act in "tw" else KEYS
    assert {key for key in asked if allows(rules, role, WIRE[act], key)} == keys_of(role, act)


def allows(rules: dict[str, Any], name: str, needed: tuple[tuple[str, str], ...], key: str) -> bool:
    """Tell whether all that is needed is allowed to a common name on a key, as Zenoh decides it."""
    subjects = {subject["id"] for subject in rules["subjects"] if name in subject["cert_common_names"]}
    ids = {rule for policy in rules["policies"] if subjects & set(policy["subjects"]) for rule in policy["rules"]}
    mine = [rule for rule in rules["rules"] if rule["id"] in ids]
    return all(
        any(
            flow in rule["flows"] and message in rule["messages"] and includes(rule["key_exprs"], f"zsim/{key}")
            for rule in mine
        )
        for flow, message in needed
    )


def includes(expressions: list[str], key: str) -> bool:
    return any(zenoh.KeyExpr(expression).includes(zenoh.KeyExpr(key)) for expression in expressions)


def test_what_is_not_granted_is_denied_and_zenoh_takes_the_whole(scenario: Any) -> None:
    rules = access_control(scenario, ROLES, {"router.site": ["estimator.drone2"]}, ["world"])
    assert rules["default_permission"] == "deny"
    assert {rule["permission"] for rule in rules["rules"]} == {"allow"}
    config = zenoh.Config()
    config.insert_json5("access_control", json.dumps(rules))


def test_a_router_may_do_what_those_behind_it_may_and_no_more(scenario: Any) -> None:
    rules = access_control(scenario, (), {"router.site": ["estimator.drone1", "controller.main"]})
    for act in ACTS:
        asked = TOKENS if act in "tw" else KEYS
        allowed = {key for key in asked if allows(rules, "router.site", WIRE[act], key)}
        assert allowed == keys_of("estimator.drone1", act) | keys_of("controller.main", act)


def test_who_is_not_named_gets_nothing(scenario: Any) -> None:
    rules = access_control(scenario, ["estimator.drone1"], {})
    assert not any(allows(rules, "estimator.drone2", WIRE[act], key) for act in ACTS for key in KEYS)


@pytest.mark.parametrize(
    ("process", "like"),
    [("my.drone1", "estimator.drone1"), ("fence.main", "controller.main")],
)
def test_a_process_that_takes_the_place_of_ours_has_its_rights(scenario: Any, process: str, like: str) -> None:
    own = {f"{of}/{name}" for of in ("process", "view/estimates") for name in (like, process)}

    def of_others(name: str, act: str) -> set[str]:
        expressions = getattr(rights.of(name, scenario), ACTS[act])
        return {expression for expression in expressions if not any(expression.startswith(key) for key in own)}

    assert all(of_others(process, act) == of_others(like, act) for act in ACTS)


@pytest.mark.parametrize(
    "process", ["world.spare", "recorder.spare", "fence.round", "console", "estimator.drone9", "controller.drone1"]
)
def test_a_process_about_nothing_known_hears_what_all_are_told(scenario: Any, process: str) -> None:
    found = rights.of(process, scenario)
    assert found.reads == ("world/info", "clock", "world/event", "world/faults")
    assert all(key.startswith(f"process/{process}/") for key in found.writes)


def test_the_federation_s_name_stands_before_every_key(scenario: Any) -> None:
    rules = access_control(scenario_file.from_text(SCENARIO + "federation: lab2\n"), ROLES, {})
    assert all(key.startswith("lab2/") for rule in rules["rules"] for key in rule["key_exprs"])
