"""Which messages of pages reach viser. The event of viser's message buffers, set from other threads while pages wait for it."""

import asyncio
import threading
import warnings
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from viser._messages import GuiUpdateMessage

from zsim_bridges.console.page_server import (
    OPERATOR,
    VIEWER,
    AnyThreadEvent,
    Buffer,
    PageControls,
    PrivateViser,
    ViewerCamera,
    is_permitted,
)

CAMERA = msgspec.to_builtins(
    ViewerCamera((1, 0, 0, 0), (1.0, 2.5, 3.0), 1.3, 0.01, 1000, 600, 800, (0, 0, 0), (0, 0, 1))
)
UPDATE = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": True}}


def test_a_viewer_steers_nothing_but_its_own_page():
    packed = msgspec.msgpack.encode
    there = controls(a=True)
    assert is_permitted(packed(CAMERA), VIEWER, there)
    assert not is_permitted(packed(UPDATE), VIEWER, there)
    assert is_permitted(packed(UPDATE), OPERATOR, there)


CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": (0.0, 0.0, 1.0),
    "ray_direction": (0.0, 1.0, 0.0),
    "screen_pos": ((0.5, 0.5),),
    "modifier": None,
}


@pytest.mark.parametrize("role", [OPERATOR, VIEWER])
def test_every_page_may_click_into_its_scene(role: str):
    def permitted(**fields: Any) -> bool:
        return is_permitted(msgspec.msgpack.encode({**CLICK, **fields}), role, controls())

    assert permitted()
    assert permitted(modifier="shift")
    assert not permitted(type="SceneNodeClickMessage", name="/drones")
    assert not permitted(event_type="rect-select")
    assert not permitted(ray_origin=(0.0, float("nan"), 0.0))
    assert not permitted(ray_direction=None)
    assert not permitted(screen_pos=())
    assert not permitted(modifier="x" * 65)


def controls(**values: Any) -> PageControls:
    """Return what is known of controls that hold such values; a list is that of a dropdown."""
    handles = {
        uuid: SimpleNamespace(value=now[0], options=now) if isinstance(now, list) else SimpleNamespace(value=now)
        for uuid, now in values.items()
    }
    gui: Any = SimpleNamespace(_gui_input_handle_from_uuid=handles)
    return PageControls(gui)


@pytest.mark.parametrize(
    ("now", "good", "bad"),
    [
        (False, [True], [1, 0.5, "x"]),
        (1, [2, 0.5, -3], [True, "x", "", 1e300]),
        (0.5, [2, 0.5], [False, "0.5"]),
        ("drone1", ["", "anything"], [True, 1]),
        (["gust", "updraught"], ["gust"], ["Gust", "", 1, True]),
    ],
)
def test_a_control_takes_what_its_page_could_put_into_it(now: Any, good: list[Any], bad: list[Any]):
    there = controls(a=now)
    change = {value: msgspec.msgpack.encode({**UPDATE, "updates": {"value": value}}) for value in good}
    assert all(is_permitted(change[value], OPERATOR, there) for value in good)
    for value in bad:
        assert not is_permitted(msgspec.msgpack.encode({**UPDATE, "updates": {"value": value}}), OPERATOR, there)
    assert not is_permitted(change[good[0]], OPERATOR, controls(b=now))


@pytest.mark.parametrize(
    "change",
    [
        msgspec.msgpack.encode({"type": "ShareUrlRequest"}),  # would show the page on the Internet
        msgspec.msgpack.encode({"type": "FileTransferStartUpload"}),
        msgspec.msgpack.encode({"type": ["GuiUpdateMessage"]}),
        msgspec.msgpack.encode({"type": "ViewerCameraMessage"}),
        msgspec.msgpack.encode({**CAMERA, "position": None}),
        msgspec.msgpack.encode({**CAMERA, "fov": float("nan")}),
        msgspec.msgpack.encode({**UPDATE, "updates": {"value": None}}),
        msgspec.msgpack.encode({**UPDATE, "updates": {"value": [1]}}),
        msgspec.msgpack.encode({**UPDATE, "updates": {"label": "x"}}),
        msgspec.msgpack.encode({**UPDATE, "updates": {"value": "x" * 3_000}}),
        msgspec.msgpack.encode([1, 2]),
        msgspec.msgpack.encode({}),
        b"\xc1",
        b"",
        msgspec.msgpack.encode({**UPDATE, "updates": {"value": "x" * 200_000}}),
    ],
)
def test_nobody_says_what_no_control_says(change: bytes):
    assert not is_permitted(change, OPERATOR, controls(a=True))


def test_another_thread_marks_it_and_the_loop_wakes_who_waits():
    async def steps() -> None:
        event = AnyThreadEvent()
        waiting = [asyncio.ensure_future(event.wait()) for _ in range(3)]
        await asyncio.sleep(0)
        in_thread = threading.Thread(target=event.set)
        in_thread.start()
        in_thread.join()
        assert event.is_set()
        assert len(event._waiters) == 3
        assert not any(waiter.done() for waiter in event._waiters)
        event.set()
        assert await asyncio.gather(*waiting) == [True] * 3

    asyncio.run(steps())


def test_visers_buffers_are_ours():
    made = PrivateViser()
    try:
        assert isinstance(made.server._websock_server._broadcast_buffer, Buffer)
        assert isinstance(made.server._websock_server._broadcast_buffer.message_event, AnyThreadEvent)
    finally:
        made.close()


def test_a_write_to_a_page_that_has_closed_is_dropped_without_a_warning():
    async def steps() -> None:
        buffer = Buffer(asyncio.get_running_loop(), persistent_messages=False)
        buffer.done = True
        buffer.push(GuiUpdateMessage("a", {"value": True}))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        asyncio.run(steps())
