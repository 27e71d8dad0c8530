"""A page's socket: what is sent when, and what becomes of a page that says nothing."""

import asyncio
from collections.abc import Callable, Coroutine
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import synthetic_camera
from aiohttp import WSMsgType

from zsim_bridges.console import page_sockets
from zsim_bridges.console.page_sockets import CameraSockets, PicturesRequest

INFO = synthetic_camera.info_of("front")
CAMERA = "drone1/front"


class Feed:
    """A camera with another picture each time that one looks."""

    def __init__(self) -> None:
        self.looked = 0
        self.asked: dict[object, tuple[str, ...]] = {}

    def cameras(self) -> tuple[Any, ...]:
        return ((CAMERA, INFO),)

    def ask(self, page: object, cameras: tuple[str, ...]) -> None:
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
    """A page, its socket, and what it is about."""

    def __init__(self) -> None:
        self.socket: Any = Socket()
        self.feed: Any = Feed()
        self.chosen: list[tuple[str, str]] = []
        self.clicked = [""]
        frustums: Any = SimpleNamespace(
            choose=self._choose, take_click=lambda _: self.clicked.pop() if self.clicked else ""
        )
        self.sockets = CameraSockets(lambda: self.feed, frustums)

    def _choose(self, page: str, camera: str) -> None:
        self.chosen.append((page, camera))


@pytest.fixture
def periods(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Let no time pass between two looks; return how long each would have been."""
    passed: list[float] = []
    sleep = asyncio.sleep

    async def pass_at_once(delay_s: float) -> None:
        passed.append(delay_s)
        await sleep(0)

    monkeypatch.setattr(page_sockets.asyncio, "sleep", pass_at_once)
    return passed


def with_page(steps: Callable[[Page], Coroutine[Any, Any, None]]) -> Page:
    """Do steps while a page's socket is served; return the page after it has closed."""
    page = Page()

    async def both() -> None:
        serving = asyncio.ensure_future(page.sockets.serve(page.socket))
        await steps(page)
        page.socket.close()
        await serving

    asyncio.run(both())
    return page


async def settled(more: int = 20) -> None:
    """Wait until the socket has had that many turns to send, if it wanted to."""
    for _ in range(more):
        await asyncio.tasks.sleep(0)


def test_a_page_that_has_not_asked_is_sent_nothing(periods: list[float]):
    async def steps(page: Page) -> None:
        await settled()
        assert page.socket.sent.empty()

    assert with_page(steps).feed.looked == 0


def test_the_next_picture_is_sent_when_the_last_is_shown(periods: list[float]):
    async def steps(page: Page) -> None:
        page.socket.say(want=(CAMERA,))
        assert (await page.socket.sent.get()).endswith(b"JPEG 1")
        await settled()
        assert page.socket.sent.empty()  # however many pictures there are
        page.socket.say(want=(CAMERA,))
        assert (await page.socket.sent.get()).endswith(b"JPEG 2")

    with_page(steps)
    assert set(periods) == {page_sockets.PERIOD_S}


def test_what_is_asked_for_is_asked_of_the_feed_the_frustums_picture_too(periods: list[float]):
    async def steps(page: Page) -> None:
        page.socket.say(want=(CAMERA,), frustum="drone2/front", page="key")
        await page.socket.sent.get()
        assert list(page.feed.asked.values()) == [(CAMERA, "drone2/front")]
        assert page.chosen == [("key", "drone2/front")]

    page = with_page(steps)
    assert page.feed.asked == {}
    assert page.chosen[-1] == ("key", "")  # closed: its frustum goes


@pytest.mark.parametrize(
    "said", [b"\x00", "", "[]", '{"want": 1}', '{"more": 1}', '{"page": "%s"}' % ("x" * 65), "[" * 50_000]
)
def test_a_page_that_says_what_is_no_request_is_left(periods: list[float], said: str | bytes):
    page = Page()

    async def steps() -> None:
        page.socket.say_raw(said)
        await page.sockets.serve(page.socket)  # returns, though the page has not closed

    asyncio.run(steps())
    assert page.socket.sent.empty()


def test_too_many_pictures_are_no_request(periods: list[float]):
    page = Page()

    async def steps() -> None:
        page.socket.say(want=("drone1/front",) * (page_sockets.WANTED_MAX + 1))
        await page.sockets.serve(page.socket)

    asyncio.run(steps())
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


def test_a_page_is_told_once_which_drone_was_clicked_in_its_scene(periods: list[float]):
    async def steps(page: Page) -> None:
        page.clicked = ["drone1"]
        page.socket.say(want=(CAMERA,))
        assert b'"clicked":"drone1"' in await page.socket.sent.get()
        page.socket.say(want=(CAMERA,))
        assert b"clicked" not in await page.socket.sent.get()

    with_page(steps)
