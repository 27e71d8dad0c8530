"""Pages of the console in a real browser, and their requests."""

import io
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from federation import Federation, Role, free_port
from wire import PATIENCE_S

VIEWPORT = {"width": 860, "height": 420}  # small, because drawing without a graphics card is slow
SCREENS = ({"width": 1600, "height": 1000}, {"width": 1280, "height": 720}, {"width": 390, "height": 844})
FOLDERS = ("Trajectory", "Any fault", "Other variables")
TABLES = ("Drones", "Events")  # tabs of the panel that is folded on a phone
IN_SIGHT = """() => ['land', 'emergency'].every(name => {
  const button = document.querySelector('#zsim-head button.' + name), box = button.getBoundingClientRect();
  const inside = box.left >= 0 && box.top >= 0 && box.right <= innerWidth && box.bottom <= innerHeight;
  return inside && document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2) === button;
})"""
FRAME_MS = 1000  # interval between frames of a scene that is not drawn
UNDRAWN_JS = f"""(() => {{
  for (const name of ["drawArrays", "drawElements", "drawArraysInstanced", "drawElementsInstanced"])
    WebGL2RenderingContext.prototype[name] = () => {{}};
  const request = window.requestAnimationFrame.bind(window), cancel = window.cancelAnimationFrame.bind(window);
  const loops = new WeakSet(), waiting = new Map();
  let number = 1e9;
  window.requestAnimationFrame = act => {{
    if (!loops.has(act)) {{ loops.add(act); return request(act); }}
    const id = ++number;
    waiting.set(id, setTimeout(() => {{ waiting.delete(id); request(act); }}, {FRAME_MS}));
    return id;
  }};
  window.cancelAnimationFrame = id => {{ cancel(id); clearTimeout(waiting.get(id)); waiting.delete(id); }};
}})();"""
"""Disables drawing of the scene and slows down animation loops, the greatest costs without a graphics card."""
POLL_MS = 100  # interval at which a page's state is polled
PATIENCE_MS = 1000 * PATIENCE_S
PICTURES = os.environ.get("ZSIM_TEST_PICTURES")  # folder for screenshots of pages, for visual inspection
HOLD_MS = 600  # time for which a button of an emergency or a takeover must be held down, from orders.html


class BrowserPage:
    """A page of the console, its requests and its script errors."""

    def __init__(self, page: Any, address: str) -> None:
        self.page = page
        self.requested: list[str] = []
        self.faults: list[str] = []
        page.set_default_timeout(PATIENCE_MS)
        page.on("request", lambda request: self.requested.append(request.url))
        page.on("websocket", lambda socket: self.requested.append(socket.url))
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.goto(address)

    def press(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    @contextmanager
    def held(self, selector: str) -> Iterator[None]:
        """Hold a button down with the mouse during the block."""
        self.page.locator(selector).hover()
        self.page.mouse.down()
        try:
            yield
        finally:
            self.page.mouse.up()

    def select_tab(self, tab: str) -> None:
        wanted = self.page.get_by_role("tab", name=tab, exact=True)
        if tab in TABLES:
            self._unfold(wanted)
        elif (folded := self.page.get_by_label("Collapse panel Drones")).is_visible():
            folded.click()
        wanted.click()

    def _unfold(self, tab: Any) -> None:
        """Unfold the panel of tables if it is folded."""
        row = self.page.get_by_label("Expand panel Drones")
        row.or_(tab).first.wait_for(state="attached")
        if row.is_visible():
            row.click()

    def open_folders(self) -> None:
        """Open the folders of the visible tab."""
        for name in FOLDERS:
            folder = self.page.get_by_text(name, exact=True).first
            if folder.is_visible() and folder.locator(".tabler-icon-chevron-down").count():
                folder.click()

    def close_notice(self) -> None:
        """Close viser's notice of software WebGL, which it shows without a graphics card."""
        self.page.locator(".mantine-Notification-closeButton").click()

    def wait_for_notice(self) -> None:
        """Wait until viser's notice of software WebGL appears."""
        self.page.locator(".mantine-Notification-closeButton").wait_for()

    def wait_for_text(self, text: str) -> None:
        """Wait until the page shows a text."""
        self.page.get_by_text(text).first.wait_for()

    def state(self) -> dict[str, Any]:
        """Return the state that the page shows, from the address that the page reads it from."""
        return self.page.evaluate("fetch(location.pathname.replace(/\\/$/, '') + '/state').then(r => r.json())")

    def until(self, condition: str) -> dict[str, Any]:
        """Wait until a condition (JavaScript) on the state `s` holds; return the state."""
        there = f"(() => {{ try {{ return {condition}; }} catch {{ return false; }} }})()"  # it may show no run yet
        look = f"async () => {{ const s = await (await fetch('/state')).json(); return [{there}, s]; }}"
        until_s = time.monotonic() + PATIENCE_S
        while True:
            holds, state = self.page.evaluate(look)
            if holds:
                return state
            assert time.monotonic() < until_s, f"{condition} never came true: {state}"
            self.page.wait_for_timeout(POLL_MS)

    def until_ground(self, is_so: Callable[[float, float], bool]) -> None:
        """Wait until a condition on the result of `ground` holds."""
        until_s, found = time.monotonic() + PATIENCE_S, (math.nan, math.nan)
        while not is_so(*found):
            assert time.monotonic() < until_s, f"the ground is of lightness and deviation {found}"
            found = self.ground()

    def ground(self) -> tuple[float, float]:
        """Return the mean lightness, from 0 to 1, and its deviation in the lowest part of the scene, the ground."""
        image = pytest.importorskip("PIL.Image")
        box = self.page.locator("canvas[data-engine]").bounding_box()
        clip = {**box, "y": box["y"] + 0.85 * box["height"], "height": 0.12 * box["height"]}
        light = np.asarray(image.open(io.BytesIO(self.page.screenshot(clip=clip))).convert("L")) / 255.0
        return float(light.mean()), float(light.std())

    def outside(self) -> set[str]:
        """Return the hosts other than this machine to which it has sent requests."""
        urls = (urlsplit(url) for url in self.requested)
        return {str(url.hostname) for url in urls if url.scheme not in ("data", "blob")} - {"127.0.0.1"}


@contextmanager
def opening(browser: Any) -> Iterator[Callable[..., BrowserPage]]:
    """Yield a function that opens an address with cookies of its own; the scene is drawn only if `drawn`."""
    with ExitStack() as stack:

        def open_it(address: str, viewport: dict[str, int] = VIEWPORT, drawn: bool = False) -> BrowserPage:
            context = browser.new_context(viewport=viewport)
            stack.callback(context.close)
            if not drawn and not PICTURES:
                context.add_init_script(UNDRAWN_JS)
            return BrowserPage(context.new_page(), address)

        yield open_it


@pytest.fixture
def opened(browser: Any) -> Iterator[Callable[..., BrowserPage]]:
    with opening(browser) as open_it:
        yield open_it


def console(federation: Federation, *options: str) -> tuple[Role, dict[str, str]]:
    """Start a console; return it and its links to steer and to look."""
    role = federation.role("console", "--port", str(free_port()), *options)
    steer = role.line("steer at").text.rpartition(" ")[2]
    return role, {"steer": steer, "look": role.line("watch only").text.rpartition(" ")[2]}
