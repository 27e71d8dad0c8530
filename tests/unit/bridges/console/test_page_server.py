"""Who may open a page, the files that a run leaves for open pages, and which of the pages' messages reach viser."""

import asyncio
import os
import socket
import threading
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from viser._messages import GuiUpdateMessage

from zsim.errors import RunError
from zsim_bridges.console import page_server
from zsim_bridges.console.page_server import (
    OPERATOR,
    VIEWER,
    AnyThreadEvent,
    Buffer,
    ListenAddress,
    PageControls,
    PageRequest,
    PageTokens,
    PrivateViser,
    RunFiles,
    ViewerCamera,
    is_permitted,
)


def asked(path: str = "/", host: str = "127.0.0.1:8080", origin: str | None = None, token: str = "", **cookies: str):
    return PageRequest(path, host, origin, token, cookies)


COOKIE, VIEWERS = {"zsim_operator_8080": "steer"}, {"zsim_viewer_8080": "look"}


@pytest.mark.parametrize(
    ("token", "request_", "role"),
    [
        (None, asked(), OPERATOR),  # only this machine can connect
        (None, asked("/view/state"), VIEWER),
        (None, asked(origin="http://127.0.0.1:8080"), OPERATOR),
        (None, asked(host="evil.example:8080"), None),  # a page of another site
        (None, asked(origin="http://evil.example"), None),
        (None, asked(origin="http://127.0.0.1:9000"), None),
        (None, asked(origin="null"), None),
        (None, asked(host="[::1:8080"), None),
        ("steer", asked(host="lab:8080"), None),
        ("steer", asked(token="wrong"), None),
        ("steer", asked(token="steer"), OPERATOR),
        ("steer", asked(**COOKIE), OPERATOR),
        ("steer", asked(zsim_operator_8081="steer"), None),
        ("steer", asked(origin="http://evil.example", **COOKIE), None),
        ("steer", asked(origin="http://[bad", **COOKIE), None),
        ("steer", asked("/view", token="look"), VIEWER),
        ("steer", asked("/view", **VIEWERS), VIEWER),
        ("steer", asked("/view", token="steer"), VIEWER),
        ("steer", asked("/", token="look"), None),
        ("steer", asked("/", zsim_operator_8080="look", **VIEWERS), None),
    ],
)
def test_a_page_is_opened_with_its_token_or_from_this_machine(
    token: str | None, request_: PageRequest, role: str | None
):
    listen = "127.0.0.1" if token is None else "0.0.0.0"
    assert PageTokens(listen, 8080, token, "look").role_of(request_) == role


def test_serving_other_machines_needs_a_token():
    with pytest.raises(RunError, match=r"0\.0\.0\.0"):
        PageTokens("0.0.0.0", 8080, None, "look")
    with pytest.raises(RunError, match="token"):
        PageTokens("127.0.0.1", 8080, "", "look")


def test_a_link_names_this_machine_when_listening_on_all_addresses():
    assert ListenAddress("127.0.0.1", 8080).url() == "http://127.0.0.1:8080/"
    assert ListenAddress("::1", 8080).url("/view") == "http://[::1]:8080/view"
    for everywhere in ("0.0.0.0", "::"):
        assert ListenAddress(everywhere, 8080).url("/", "a b&#").endswith(":8080/?token=a%20b%26%23")
        address = ListenAddress(everywhere, 8080).url("/", "steer")
        assert address == f"http://{socket.gethostname()}:8080/?token=steer"


PAGE = "a page"


class Clock:
    """Wall time that passes only during sleeps.

    Attributes:
        now_s: the current time.
    """

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.at_sleep = lambda: None

    def time(self) -> float:
        return self.now_s

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.at_sleep()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(page_server, "time", made)
    return made


def test_existing_files_are_shown_with_their_sizes(tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    (tmp_path / "run.mcap").write_bytes(b"1234567")
    shown = files.state(PAGE, has_copies=False)
    assert not shown["leaves"]
    assert {name: each["size_bytes"] for name, each in shown["files"].items()} == {"report": None, "record": 7}
    assert shown["files"]["record"]["path"] == str(tmp_path / "run.mcap")


def test_a_console_without_a_folder_shows_no_files() -> None:
    assert RunFiles(None).state(PAGE, has_copies=False) == {"files": {}, "leaves": False}


@pytest.mark.parametrize(
    ("looks", "copied_s", "deserted_s", "waited_s"),
    [
        ({}, None, None, 0.0),
        ({PAGE: False}, 5.0, None, 5.0),
        ({PAGE: True}, None, None, 0.0),
        ({PAGE: False}, 1e9, None, 20.0),  # never gets its copies
        ({PAGE: False, "another page": True}, None, None, page_server.POLL_TIMEOUT_S),  # the other page was closed
        ({"": False}, None, None, 0.0),  # not a page
        ({PAGE: False}, None, 1.0, 1.0),
    ],
)
def test_the_console_waits_until_open_pages_have_their_copies(
    clock: Clock,
    tmp_path: Path,
    looks: dict[str, bool],
    copied_s: float | None,
    deserted_s: float | None,
    waited_s: float,
) -> None:
    files = RunFiles(tmp_path)
    for page, has_copies in looks.items():
        assert not files.state(page, has_copies)["leaves"]
    if copied_s is not None:
        clock.at_sleep = lambda: files.state(PAGE, clock.now_s > 1000.0 + copied_s)  # type: ignore[func-returns-value]
    files.offer(20.0, is_abandoned=lambda: deserted_s is not None and clock.now_s > 1000.0 + deserted_s)
    assert clock.now_s == pytest.approx(1000.0 + waited_s, abs=2 * page_server.POLL_S)
    assert files.state(PAGE, has_copies=True)["leaves"]


def test_the_number_of_known_pages_is_bounded(clock: Clock, tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    for number in range(10 * page_server.POLLING_PAGES_MAX):
        files.state(f"page {number}", has_copies=False)
    assert len(files._polled_s) == page_server.POLLING_PAGES_MAX


def test_a_report_of_an_earlier_run_is_not_shown(tmp_path: Path) -> None:
    report = tmp_path / "report.html"
    report.write_text("of another run")
    os.utime(report, (1.0, 1.0))
    files = RunFiles(tmp_path)
    assert files.state("", has_copies=False)["files"]["report"]["size_bytes"] is None
    report.write_text("of this run")
    assert files.state("", has_copies=False)["files"]["report"]["size_bytes"] == len("of this run")


CAMERA = msgspec.to_builtins(
    ViewerCamera((1, 0, 0, 0), (1.0, 2.5, 3.0), 1.3, 0.01, 1000, 600, 800, (0, 0, 0), (0, 0, 1))
)
UPDATE = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": True}}


def test_a_viewer_controls_only_the_camera_of_its_page():
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
def test_every_page_may_click_in_its_scene(role: str):
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
    """Return controls with the given values; a list holds the options of a dropdown."""
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
def test_a_control_accepts_only_values_that_a_page_could_enter(now: Any, good: list[Any], bad: list[Any]):
    there = controls(a=now)
    change = {value: msgspec.msgpack.encode({**UPDATE, "updates": {"value": value}}) for value in good}
    assert all(is_permitted(change[value], OPERATOR, there) for value in good)
    for value in bad:
        assert not is_permitted(msgspec.msgpack.encode({**UPDATE, "updates": {"value": value}}), OPERATOR, there)
    assert not is_permitted(change[good[0]], OPERATOR, controls(b=now))


@pytest.mark.parametrize(
    "change",
    [
        msgspec.msgpack.encode({"type": "ShareUrlRequest"}),  # would publish the page on the Internet
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
def test_messages_that_no_control_sends_are_refused(change: bytes):
    assert not is_permitted(change, OPERATOR, controls(a=True))


def test_an_event_set_in_a_thread_wakes_its_waiters_only_in_the_loop():
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


def test_viser_uses_the_replaced_buffers():
    made = PrivateViser()
    try:
        assert isinstance(made.server._websock_server._broadcast_buffer, Buffer)
        assert isinstance(made.server._websock_server._broadcast_buffer.message_event, AnyThreadEvent)
    finally:
        made.close()


def test_a_write_to_a_closed_page_is_dropped_without_a_warning():
    async def steps() -> None:
        buffer = Buffer(asyncio.get_running_loop(), persistent_messages=False)
        buffer.done = True
        buffer.push(GuiUpdateMessage("a", {"value": True}))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        asyncio.run(steps())
