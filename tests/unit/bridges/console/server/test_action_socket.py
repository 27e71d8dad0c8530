"""What a page may do in its scene."""

import json
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from zsim_bridges.console.manual_flight import FlightAnswer, Stick
from zsim_bridges.console.page_server import OPERATOR, VIEWER
from zsim_bridges.console.page_sockets import ActionSockets

LOOK = {"do": "look", "page": "key", "follows": True, "fits": False, "direction": "top"}


class Actions:
    """The actions of one page, whose key is `key` and whose number 7."""

    def __init__(self) -> None:
        self.looked: list[tuple[Any, ...]] = []
        cameras: Any = SimpleNamespace(choose=lambda *args: self.looked.append(args))
        self.played: list[tuple[str, float]] = []
        self.record: Any = SimpleNamespace(play=lambda *args: self.played.append(args))
        self._sockets = ActionSockets({"key": 7}.get, cameras, lambda: self.record)

    def act(self, role: str, **action: Any) -> bool:
        return self._sockets.act(json.dumps(action), role) is not None


@pytest.mark.parametrize("role", [OPERATOR, VIEWER])
def test_every_page_moves_its_own_camera(role: str):
    actions = Actions()
    assert actions.act(role, **LOOK)
    assert actions.act(role, **LOOK | {"page": "gone"})
    assert actions.looked == [(7, True, False, "top")]


@pytest.mark.parametrize(
    "change", [{"do": "stop"}, {"direction": "below"}, {"page": "x" * 65}, {"follows": 1}, {"more": 0}]
)
def test_what_is_no_action_closes_the_socket(change: dict[str, Any]):
    actions = Actions()
    assert not actions.act(OPERATOR, **LOOK | change)
    assert actions.looked == []


def test_an_operator_plays_a_record_and_a_viewer_does_not():
    actions = Actions()
    assert actions.act(OPERATOR, do="play", op="seek", value=5.0)
    assert not actions.act(VIEWER, do="play", op="seek", value=5.0)
    assert actions.played == [("seek", 5.0)]


def test_without_a_run_nothing_is_played():
    actions = Actions()
    actions.record = None
    assert actions.act(OPERATOR, do="play", op="pause")
    assert actions.played == []


@pytest.mark.parametrize("change", [{"op": "acquire"}, {"value": -1.0}, {"value": 1e10}, {"value": "1"}])
def test_what_no_timeline_says_closes_the_socket(change: dict[str, Any]):
    assert not Actions().act(OPERATOR, **{"do": "play", "op": "seek", "value": 1.0} | change)


class FakeFlying:
    """What pages may do with single drones, noted."""

    def __init__(self) -> None:
        self.chosen: list[tuple[Any, str]] = []
        self.refused: int | None = -1  # page that another one keeps from flying
        self.done: list[tuple[Any, ...]] = []
        self.control: Any = SimpleNamespace(
            take=partial(self._note, "take"),
            steer=partial(self._note, "steer"),
            go=partial(self._note, "go"),
            leave=partial(self._note, "leave"),
            lose=partial(self._note, "lose"),
        )

    def _note(self, what: str, page: Any, *args: Any) -> FlightAnswer:
        self.done.append((what, page, *args))
        return FlightAnswer("drone2", "flying")

    def take_refusal(self, client_id: int | None, drone: str) -> str:
        return "main is held" if client_id == self.refused else ""

    def choose(self, client_id: int | None, drone: str) -> None:
        self.chosen.append((client_id, drone))

    def plan(self, client_id: int | None, whole: bool) -> dict[str, Any]:
        return {"page": client_id, "whole": whole}


FLYING = (
    {"do": "take", "drone": "drone2", "over": True, "id": "one"},
    {"do": "steer", "held": True, "forward": 1.0},
    {"do": "go", "x_m": 3.0, "y_m": -2.0, "z_m": 4.0},
    {"do": "leave"},
)


def flying_sockets() -> tuple[FakeFlying, ActionSockets]:
    flying: Any = FakeFlying()
    cameras: Any = SimpleNamespace()
    return flying, ActionSockets({"key": 7}.get, cameras, lambda: None, lambda: flying)


def test_an_operator_flies_a_drone_and_is_answered():
    flying, sockets = flying_sockets()
    for action in FLYING:
        answer = sockets.act(json.dumps(action), OPERATOR, "here") or {}
        assert answer["flight"]["state"] == "flying"
    stick = Stick(1.0, 0.0, 0.0, 0.0, 1.0)
    assert flying.done == [
        ("take", "here", "drone2", True, "one"), ("steer", "here", stick), ("go", "here", 3.0, -2.0, 4.0), ("leave", "here"),
    ]  # fmt: skip
    sockets.lose("here")
    assert flying.done[-1] == ("lose", "here")


def test_a_page_takes_no_drone_of_a_formation_that_another_page_is_in_control_of():
    flying, sockets = flying_sockets()
    flying.refused = 7
    sockets.act(json.dumps({"do": "plan", "page": "key"}), OPERATOR, "here")
    answer = sockets.act(json.dumps(FLYING[0]), OPERATOR, "here") or {}
    assert (answer["flight"]["state"], answer["flight"]["text"]) == ("none", "main is held")
    assert flying.done == []
    sockets.lose("here")  # the next page at that socket is not yet known
    assert (sockets.act(json.dumps(FLYING[0]), OPERATOR, "here") or {})["flight"]["state"] == "flying"


@pytest.mark.parametrize("action", FLYING, ids=lambda action: action["do"])
def test_a_viewer_who_would_fly_is_closed(action: dict[str, Any]):
    flying, sockets = flying_sockets()
    assert sockets.act(json.dumps(action), VIEWER, "here") is None
    assert flying.done == []


@pytest.mark.parametrize("role", [OPERATOR, VIEWER])
def test_every_page_sees_the_plan_and_chooses_a_drone_of_its_own(role: str):
    flying, sockets = flying_sockets()
    looked = sockets.act(json.dumps({"do": "plan", "page": "key", "whole": True}), role)
    assert looked == {"plan": {"page": 7, "whole": True}}
    assert sockets.act(json.dumps({"do": "choose", "page": "key", "drone": "drone3"}), role) == {}
    assert flying.chosen == [(7, "drone3")]


@pytest.mark.parametrize(
    "change", [{"forward": 1.1}, {"held": 1}, {"speed_m_s": -1.0}, {"speed_m_s": 1e3}, {"drone": "drone2"}]
)
def test_a_stick_beyond_its_stops_closes_the_socket(change: dict[str, Any]):
    flying, sockets = flying_sockets()
    assert sockets.act(json.dumps({"do": "steer", "held": True} | change), OPERATOR) is None
    assert flying.done == []
