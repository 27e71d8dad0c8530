"""What a page may do in its scene."""

import json
from types import SimpleNamespace
from typing import Any

import pytest

from zsim_bridges.console.server.action_socket import ActionSockets
from zsim_bridges.console.server.page_tokens import OPERATOR, VIEWER

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
        return self._sockets.act(json.dumps(action), role)


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
