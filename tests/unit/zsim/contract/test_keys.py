"""Keys: names, builders, and agreement with Zenoh on the keys that an expression matches."""

import time

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import has_terms

from zsim.contract import keys
from zsim.errors import BadNameError


@pytest.mark.parametrize("name", ["a", "drone1", "estimator.drone1", "x_y-z.0", "9", "a" * 32, ".", "-"])
def test_valid_names_are_accepted(name: str):
    assert keys.name(name) == name


@pytest.mark.parametrize(
    "name",
    ["", "a" * 33, "Drone", "a/b", "a b", "drone1\n", "*", "**", "$*", "é", "a\0", "@a", "#", "?", None, 1, b"drone1"],
)
def test_invalid_names_are_refused_with_what_is_allowed(name):
    with pytest.raises(BadNameError) as caught:
        keys.name(name, "federation")
    error = str(caught.value)
    assert has_terms(error, "federation", f"{name!r}", "1", "32", "a-z", "0-9", "_", ".", "-")
    assert "\n" not in error


def test_keys_are_those_of_the_contract():
    assert keys.sensor("drone1", "imu") == "drone/drone1/sensor/imu"
    assert keys.sensors("drone1") == "drone/drone1/sensor/*"
    assert keys.status("drone1") == "drone/drone1/sensor/status"
    assert keys.truth("drone1") == "drone/drone1/truth"
    assert keys.command("drone1", "velocity") == "drone/drone1/cmd/velocity"
    assert keys.estimate("drone1") == "drone/drone1/estimate"
    assert keys.cluster_state("main") == "cluster/main/state"
    assert keys.cluster_control("main") == "cluster/main/control"
    assert keys.token("recorder") == "process/recorder"
    assert keys.process("estimator.drone1", "done") == "process/estimator.drone1/done"
    fixed = (keys.INFO, keys.CLOCK, keys.EVENT, keys.CONTROL, keys.VIEW_DRONES)
    assert fixed == ("world/info", "clock", "world/event", "world/control", "view/drones")
    assert keys.SENSORS == ("imu", "gps", "mag", "baro", "sonar", "flow")


def test_keys_are_split_into_their_parts():
    assert keys.thing("drone/drone1/sensor/imu") == "drone1"
    assert keys.thing("process/estimator.drone1/done") == "estimator.drone1"
    assert keys.leaf("drone/drone1/sensor/imu") == "imu"
    assert keys.leaf("clock") == "clock"
    assert keys.parts("drone/drone1/cmd/velocity") == ("drone", "drone1", "cmd/velocity")
    assert keys.parts("process/world") == ("process", "world", "")
    assert keys.parts("clock") == ("clock", "", "")


@pytest.mark.parametrize(
    ("expression", "key", "takes"),
    [
        ("drone/*/truth", "drone/drone1/truth", True),
        ("drone/*/truth", "drone/drone1/sensor/imu", False),
        ("drone/**", "drone", True),
        ("**/truth", "drone/d/truth", True),
        ("a/**/z", "a/b/c/z", True),
        ("drone/drone.1/truth", "drone/droneX1/truth", False),
        ("drone/d$*/truth", "drone/drone1/truth", True),
        ("*", "@adm", False),
        ("@adm/*", "@adm/x", True),
        ("", "clock", False),
    ],
)
def test_an_expression_matches_the_right_keys(expression: str, key: str, takes: bool):
    assert keys.matches(expression, key) is takes


words = st.text(alphabet="ab@.", min_size=1, max_size=3)
partly = st.lists(st.text(alphabet="ab@", max_size=2), min_size=2, max_size=4).map("$*".join)
expressions = st.lists(words | st.just("*") | st.just("**") | partly, min_size=1, max_size=6).map("/".join)
some_keys = st.lists(words, min_size=1, max_size=7).map("/".join)


@settings(max_examples=500, deadline=None)
@given(expression=expressions, key=some_keys, texts=st.tuples(st.text(max_size=20), st.text(max_size=20)))
def test_matches_agrees_with_zenoh_and_answers_any_text(expression: str, key: str, texts: tuple[str, str]):
    assert keys.matches(*texts) in (True, False)
    try:
        asked = zenoh.KeyExpr(expression)
    except zenoh.ZError:
        return  # not canonical: "**/**", "*/**/*", "$*" alone
    found = zenoh.KeyExpr(key)
    takes = keys.matches(expression, key)
    assert takes == asked.intersects(found)
    assert takes == asked.includes(found)


@pytest.mark.parametrize(
    ("expression", "key"),
    [
        ("**/a/" * 40 + "b", "a/" * 400 + "c"),
        ("**/*/" * 40 + "b", "a/" * 400 + "c"),
        ("x" + "$*a" * 40 + "$*b", "x" + "a" * 4000),
    ],
)
def test_a_contrived_expression_is_matched_quickly(expression: str, key: str):
    start_s = time.process_time()
    assert not keys.matches(expression, key)
    assert time.process_time() - start_s < 1.0
