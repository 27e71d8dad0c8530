"""The sockets of a page: the actions that it may send, and when it is sent camera pictures."""

import asyncio
import json
from collections.abc import Callable, Coroutine
from functools import partial
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import synthetic_camera
from aiohttp import WSMsgType

from zsim_bridges.console import page_sockets
from zsim_bridges.console.manual_flight import FlightAnswer, Stick
from zsim_bridges.console.page_server import OPERATOR, VIEWER
from zsim_bridges.console.page_sockets import ActionSockets, CameraSockets, PicturesRequest

LOOK = {"do": "look", "page": "key", "follows": True, "fits": False, "direction": "top"}


class Actions:
    """The actions of one page, with the key `key` and the client ID 7."""

    def __init__(self) -> None:
        self.looked: list[tuple[Any, ...]] = []
        cameras: Any = SimpleNamespace(look=lambda *args: self.looked.append(args), client_id={"key": 7}.get)
        self.played: list[tuple[str, float]] = []
        self.record: Any = SimpleNamespace(play=lambda *args: self.played.append(args))
        self._sockets = ActionSockets(cameras, lambda: self.record)

    def act(self, role: str, **action: Any) -> bool:
        return self._sockets.act(json.dumps(action), role) is not None


@pytest.fixture
def actions() -> Actions:
    return Actions()


@pytest.mark.parametrize("role", [OPERATOR, VIEWER])
def test_every_page_may_move_its_own_camera(role: str, actions: Actions):
    assert actions.act(role, **LOOK)
    assert actions.act(role, **LOOK | {"page": "gone"})
    assert actions.looked == [(7, True, False, "top")]


PLAY, STEER = {"do": "play", "op": "seek", "value": 1.0}, {"do": "steer", "held": True}
NO_ACTIONS = [
    *(
        LOOK | change
        for change in ({"do": "stop"}, {"direction": "below"}, {"page": "x" * 65}, {"follows": 1}, {"more": 0})
    ),
    *(PLAY | change for change in ({"op": "acquire"}, {"value": -1.0}, {"value": 1e10}, {"value": "1"})),
    *(
        STEER | change
        for change in ({"forward": 1.1}, {"held": 1}, {"speed_m_s": -1.0}, {"speed_m_s": 1e3}, {"drone": "drone2"})
    ),
]


@pytest.mark.parametrize("action", NO_ACTIONS)
def test_an_invalid_action_closes_the_socket(action: dict[str, Any], actions: Actions):
    assert not actions.act(OPERATOR, **action)
    assert (actions.looked, actions.played) == ([], [])
    flying, sockets = flying_sockets()
    assert sockets.act(json.dumps(action), OPERATOR) is None
    assert flying.done == []


def test_only_an_operator_may_play_a_record(actions: Actions):
    assert actions.act(OPERATOR, do="play", op="seek", value=5.0)
    assert not actions.act(VIEWER, do="play", op="seek", value=5.0)
    actions.record = None  # without a run nothing is played
    assert actions.act(OPERATOR, do="play", op="pause")
    assert actions.played == [("seek", 5.0)]


class FakeFlying:
    """Records what pages do with single drones."""

    def __init__(self) -> None:
        self.chosen: list[tuple[Any, str]] = []
        self.refused: int | None = -1  # the page that another one keeps from flying
        self.done: list[tuple[Any, ...]] = []
        does = ("take", "steer", "go", "leave", "lose")
        self.control: Any = SimpleNamespace(**{what: partial(self._note, what) for what in does})
        self.pages: Any = SimpleNamespace(
            choose=lambda *chosen: self.chosen.append(chosen),
            use=lambda client_id, drone: "main is held" if client_id == self.refused else "",
        )

    def _note(self, what: str, page: Any, *args: Any) -> FlightAnswer:
        self.done.append((what, page, *args))
        return FlightAnswer("drone2", "flying")

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
    cameras: Any = SimpleNamespace(client_id={"key": 7}.get)
    return flying, ActionSockets(cameras, lambda: None, lambda: flying)


def test_an_operator_may_fly_a_drone_and_is_answered():
    flying, sockets = flying_sockets()
    for action in FLYING:
        answer = sockets.act(json.dumps(action), OPERATOR, "here") or {}
        assert answer["flight"]["state"] == "flying"
    stick = Stick(1.0, 0.0, 0.0, 0.0, 1.0)
    assert flying.done == [
        ("take", "here", "drone2", True, "one"), ("steer", "here", stick), ("go", "here", 3.0, -2.0, 4.0, False), ("leave", "here"),
    ]  # fmt: skip
    sockets.lose("here")
    assert flying.done[-1] == ("lose", "here")


def test_a_drone_of_a_formation_held_by_another_page_is_refused():
    flying, sockets = flying_sockets()
    flying.refused = 7
    sockets.act(json.dumps({"do": "plan", "page": "key"}), OPERATOR, "here")
    answer = sockets.act(json.dumps(FLYING[0]), OPERATOR, "here") or {}
    assert (answer["flight"]["state"], answer["flight"]["text"]) == ("none", "main is held")
    assert flying.done == []
    sockets.lose("here")  # the next page on that socket is not yet known
    assert (sockets.act(json.dumps(FLYING[0]), OPERATOR, "here") or {})["flight"]["state"] == "flying"


@pytest.mark.parametrize("action", FLYING, ids=lambda action: action["do"])
def test_a_viewer_that_tries_to_fly_is_disconnected(action: dict[str, Any]):
    flying, sockets = flying_sockets()
    assert sockets.act(json.dumps(action), VIEWER, "here") is None
    assert flying.done == []


@pytest.mark.parametrize("role", [OPERATOR, VIEWER])
def test_every_page_sees_the_plan_and_may_choose_a_drone(role: str):
    flying, sockets = flying_sockets()
    looked = sockets.act(json.dumps({"do": "plan", "page": "key", "whole": True}), role)
    assert looked == {"plan": {"page": 7, "whole": True}}
    assert sockets.act(json.dumps({"do": "choose", "page": "key", "drone": "drone3"}), role) == {}
    assert flying.chosen == [(7, "drone3")]


INFO = synthetic_camera.info_of("front")
CAMERA = "drone1/front"


class Feed:
    """A camera that has a new picture at every look."""

    def __init__(self) -> None:
        self.looked = 0
        self.asked: dict[object, tuple[str, ...]] = {}

    def cameras(self) -> tuple[Any, ...]:
        return ((CAMERA, INFO),)

    def request_pictures(self, page: object, cameras: tuple[str, ...]) -> None:
        self.asked[page] = cameras

    def release(self, page: object) -> None:
        self.asked.pop(page, None)

    def picture(self, camera: str) -> Any:
        self.looked += 1
        image = synthetic_camera.image_message("front", self.looked, b"JPEG %d" % self.looked, 0)
        return SimpleNamespace(number=self.looked, image=image)

    def marks(self, camera: str) -> tuple[Any, ...]:
        return ()


class Socket:
    """A page's end of its socket."""

    def __init__(self) -> None:
        self._requests: asyncio.Queue[Any] = asyncio.Queue()
        self.sent: asyncio.Queue[bytes] = asyncio.Queue()

    def say(self, **fields: Any) -> None:
        self.say_raw(msgspec.json.encode(PicturesRequest(**fields)).decode())

    def say_raw(self, text: str | bytes) -> None:
        kind = WSMsgType.TEXT if isinstance(text, str) else WSMsgType.BINARY
        self._requests.put_nowait(SimpleNamespace(type=kind, data=text))

    def close(self) -> None:
        self._requests.put_nowait(None)

    def __aiter__(self) -> "Socket":
        return self

    async def __anext__(self) -> Any:
        request = await self._requests.get()
        if request is None:
            raise StopAsyncIteration
        return request

    async def send_bytes(self, data: bytes) -> None:
        self.sent.put_nowait(data)


class Page:
    """A page with its socket and its feed."""

    def __init__(self) -> None:
        self.socket: Any = Socket()
        self.feed: Any = Feed()
        self.chosen: list[tuple[str, str]] = []
        self.clicked = [""]
        frustums: Any = SimpleNamespace(
            show_frustum=lambda *chosen: self.chosen.append(chosen),
            pop_click=lambda _: self.clicked.pop() if self.clicked else "",
        )
        self.sockets = CameraSockets(lambda: self.feed, frustums)


@pytest.fixture
def periods(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Skip the sleeps between looks; return their durations."""
    passed: list[float] = []
    sleep = asyncio.sleep

    async def pass_at_once(delay_s: float) -> None:
        passed.append(delay_s)
        await sleep(0)

    monkeypatch.setattr(page_sockets.asyncio, "sleep", pass_at_once)
    return passed


def with_page(steps: Callable[[Page], Coroutine[Any, Any, None]]) -> Page:
    """Run steps while a page's socket is served; return the page after it has closed."""
    page = Page()

    async def both() -> None:
        serving = asyncio.ensure_future(page.sockets.serve(page.socket))
        await steps(page)
        page.socket.close()
        await serving

    asyncio.run(both())
    return page


async def settled(more: int = 20) -> None:
    """Give the socket a number of turns in which it could send."""
    for _ in range(more):
        await asyncio.tasks.sleep(0)


def test_the_next_picture_is_sent_only_on_request(periods: list[float]):
    async def steps(page: Page) -> None:
        await settled()
        assert (page.socket.sent.empty(), page.feed.looked) == (True, 0)  # nothing was requested
        page.socket.say(want=(CAMERA,))
        assert (await page.socket.sent.get()).endswith(b"JPEG 1")
        await settled()
        assert page.socket.sent.empty()  # although newer pictures exist
        page.socket.say(want=(CAMERA,))
        assert (await page.socket.sent.get()).endswith(b"JPEG 2")

    with_page(steps)
    assert set(periods) == {page_sockets.PERIOD_S}


def test_requested_cameras_and_the_frustum_are_requested_from_the_feed(periods: list[float]):
    async def steps(page: Page) -> None:
        page.socket.say(want=(CAMERA,), frustum="drone2/front", page="key")
        await page.socket.sent.get()
        assert list(page.feed.asked.values()) == [(CAMERA, "drone2/front")]
        assert page.chosen == [("key", "drone2/front")]

    page = with_page(steps)
    assert page.feed.asked == {}
    assert page.chosen[-1] == ("key", "")  # closing the page removes its frustum


@pytest.mark.parametrize(
    "said",
    [
        b"\x00",
        "",
        "[]",
        '{"want": 1}',
        '{"more": 1}',
        '{"page": "%s"}' % ("x" * 65),
        json.dumps({"want": [CAMERA] * (page_sockets.WANTED_MAX + 1)}),
        "[" * 50_000,
    ],
)
def test_an_invalid_request_ends_the_socket(periods: list[float], said: str | bytes):
    page = Page()

    async def steps() -> None:
        page.socket.say_raw(said)
        await page.sockets.serve(page.socket)  # returns, though the page has not closed

    asyncio.run(steps())
    assert page.socket.sent.empty()
    assert page.feed.asked == {}


def test_without_a_run_a_page_waits_for_one(periods: list[float]):
    async def steps(page: Page) -> None:
        feed, page.feed = page.feed, None
        page.socket.say(want=(CAMERA,))
        await settled()
        assert page.socket.sent.empty()
        page.feed = feed
        assert (await page.socket.sent.get()).endswith(b"JPEG 1")

    with_page(steps)


def test_a_page_is_told_once_which_drone_was_clicked(periods: list[float]):
    async def steps(page: Page) -> None:
        page.clicked = ["drone1"]
        page.socket.say(want=(CAMERA,))
        assert b'"clicked":"drone1"' in await page.socket.sent.get()
        page.socket.say(want=(CAMERA,))
        assert b"clicked" not in await page.socket.sent.get()

    with_page(steps)
