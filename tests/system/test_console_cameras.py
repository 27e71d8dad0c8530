"""Camera pictures in the console, in a real browser, with pictures that the tests publish."""

import io
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import msgspec
import numpy as np
import pytest
import synthetic_camera
from chromium import needs_browser
from console_browser import PATIENCE_MS, POLL_MS, BrowserPage, console
from federation import Federation
from meanwhile import meanwhile
from synthetic_camera import NUMBER_BITS, SETTINGS
from wire import PATIENCE_S, Client

from zsim.contract import keys, messages
from zsim_bridges.console.page_cameras import DIRECTIONS, FIT_MARGIN, fit_distance_m

LOW = {"width": 1000, "height": 480}
LAPTOP, DESK = {"width": 1280, "height": 720}, {"width": 1600, "height": 1000}
SCREENS = (LAPTOP, DESK)
TRIAD = """
name: triad
seed: 3
duration_s: 3600
sensors: {preset: paper}
drones:
  - {name: drone1, position_m: [0.0, 1.5, 0.0], yaw_deg: 90}
  - {name: drone2, position_m: [-1.5, -1.5, 0.0], yaw_deg: 90}
  - {name: drone3, position_m: [1.5, -1.5, 0.0], yaw_deg: 90}
clusters:
  - {name: main, drones: [drone1, drone2, drone3]}
"""
THREE = ("drone1", "drone2", "drone3")
SIX = [f"{drone}/{name}" for drone in THREE for name in SETTINGS]
ALONE = """
name: alone
duration_s: 3600
drones: [{name: drone1, position_m: [4, 4, 0]}]
processes: {expect: []}
"""
TWELVE = "\n".join(
    [
        "name: twelve\nduration_s: 3600\ndrones:",
        *(f"  - {{name: drone{k + 1}, position_m: [{3 * (k % 4)}, {3 * (k // 4)}, 0.0]}}" for k in range(12)),
    ]
)
EMERGENCY = "EMERGENCY – all rotors stop"
SKY = np.array(synthetic_camera.SKY[::-1])  # red, green, blue; a colour that nothing else in the scene has
SKY_PIXELS = 60  # least number of sky-coloured pixels that a frustum's picture shows
HEAD_PX = 46  # height of the page's head
HAT_PIXELS = 10  # least number of hat-coloured pixels that a drone shows
STANDS = np.array([(0.0, 1.5, 0.0), (-1.5, -1.5, 0.0), (1.5, -1.5, 0.0)])  # m, in W: positions of TRIAD's drones
FIELD_DEG = 75.0  # vertical field of view of viser's camera
NEAR = 12  # tolerance of a colour in levels of 255, for JPEG and the scene's lighting

READ_NUMBERS = """() => Object.fromEntries([...document.querySelectorAll('#zsim-cameras .picture')].map(button => {
  const image = button.querySelector('img');
  if (!image.complete || !image.naturalWidth) return [button.dataset.camera, null];
  const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight), context = canvas.getContext('2d');
  context.drawImage(image, 0, 0);
  const side = Math.floor(image.naturalHeight / 16), y = image.naturalHeight - side / 2;
  const bits = [...Array(BITS).keys()].map(bit => context.getImageData((bit + .5) * side, y, 1, 1).data[0] > 128);
  return [button.dataset.camera, bits.reduce((sum, set, bit) => sum + (set ? 1 << bit : 0), 0)];
}))""".replace("BITS", str(NUMBER_BITS))
"""Returns the number drawn into each picture that the page shows."""

COVERED = """() => [...document.querySelectorAll('#zsim-cameras .picture, #zsim-cameras text, button')].filter(each => {
  const box = each.getBoundingClientRect();
  const ours = each.closest('#zsim-cameras') || each.textContent.includes('EMERGENCY');
  if (!ours) return false;
  const inside = box.left >= 0 && box.top >= 0 && box.right <= innerWidth && box.bottom <= innerHeight;
  const at = [[.5, .5], [.05, .1], [.95, .9]].map(([x, y]) =>
    document.elementFromPoint(box.left + x * box.width, box.top + y * box.height));
  const on = each.closest('button');
  return !inside || box.width < 10 || at.some(found => !found || !on.contains(found));
}).map(each => `${each.className} ${each.dataset?.camera ?? each.textContent}`)"""
"""Returns those of the pictures, their texts and the emergency button that are cut off or covered."""

CUT_TEXTS = """() => [...document.querySelectorAll('#zsim-cameras text')].filter(text => {
  const box = text.getBoundingClientRect(), picture = text.closest('.picture').getBoundingClientRect();
  return box.left < picture.left || box.right > picture.right || box.top < picture.top || box.bottom > picture.bottom;
}).map(text => text.textContent)"""

PLACES = """() => ['canvas[data-engine]', '#zsim-cameras'].map(
  each => document.querySelector(each).getBoundingClientRect().toJSON())"""

MARK = """() => {
  const picture = document.querySelector('[data-camera="drone1/front"]'), circle = picture.querySelector('circle');
  if (!circle) return null;
  const image = picture.querySelector('img').getBoundingClientRect(), box = circle.getBoundingClientRect();
  return [(box.x + box.width / 2 - image.x) / image.width, (box.y + box.height / 2 - image.y) / image.height,
          picture.querySelector('text').textContent];
}"""


def until(page: BrowserPage, look: Callable[[], Any], holds: Callable[[Any], bool]) -> Any:
    """Poll until the value seen meets a condition, and return it."""
    until_s = time.monotonic() + PATIENCE_S
    while True:
        seen = look()
        if holds(seen):
            return seen
        assert time.monotonic() < until_s, f"it never held: {seen}"
        page.page.wait_for_timeout(POLL_MS)


def numbers(page: BrowserPage) -> dict[str, int | None]:
    return page.page.evaluate(READ_NUMBERS)


def wait_until_all_change(page: BrowserPage, cameras: list[str]) -> None:
    """Wait until every picture has been replaced by another."""
    first = until(page, lambda: numbers(page), lambda seen: list(seen) == cameras and None not in seen.values())
    changed: set[str] = set()

    def look() -> set[str]:
        changed.update(camera for camera, number in numbers(page).items() if number != first.get(camera))
        return changed

    until(page, look, lambda seen: seen >= set(cameras))


def is_stacked(places: list[dict[str, float]], screen: dict[str, int]) -> bool:
    """Return whether the scene takes most of the screen's height, and the pictures the rest, equally wide."""
    scene, pictures = places
    return (
        abs(scene["y"] + scene["height"] - pictures["y"]) < 1.5
        and abs(pictures["y"] + pictures["height"] - screen["height"]) < 1.5
        and scene["height"] > 0.55 * screen["height"]
        and abs(scene["x"] - pictures["x"]) < 1.5
        and abs(scene["width"] - pictures["width"]) < 1.5
    )


def scene_pixels(page: BrowserPage) -> np.ndarray:
    """Return the scene as rendered on the page: rows of pixels (red, green, blue)."""
    image = pytest.importorskip("PIL.Image")
    box: Any = page.page.locator("canvas[data-engine]").bounding_box()
    return np.array(image.open(io.BytesIO(page.page.screenshot(clip=box, timeout=PATIENCE_MS))).convert("RGB"), int)


def sky_pixels(page: BrowserPage) -> int:
    """Return how many pixels of the scene have the colour of the pictures' sky."""
    return int(np.count_nonzero(np.abs(scene_pixels(page) - SKY).max(axis=2) < NEAR))


def wait_for_pictures_and_drones(page: BrowserPage, cameras: list[str]) -> None:
    """Wait until a page shows the pictures, and the drones' hats in its scene; fail on an error of the page."""
    page.page.locator(".mantine-Notification-closeButton").click()  # the "software WebGL" notice of this browser

    def look() -> tuple[bool, int]:
        assert page.faults == []
        if not page.page.locator("canvas[data-engine]").count():
            return False, 0
        red, green, blue = np.moveaxis(scene_pixels(page), 2, 0)
        shown = numbers(page)
        complete = list(shown) == cameras and None not in shown.values()
        return complete, int(np.count_nonzero((red > 2 * green) & (blue > 2 * green) & (red > 100)))

    until(page, look, lambda seen: seen[0] and seen[1] > HAT_PIXELS)


def place_of(page: BrowserPage, p_W: tuple[float, float, float]) -> tuple[float, float]:
    """Reset the page's camera, and return where a point of TRIAD's scene lies on the page."""
    page.page.locator("#zsim-tools").get_by_text("Reset").click()
    page.until(f"s.t_s > {page.state()['t_s'] + 1}")  # the camera moves with the next frame
    box: Any = page.page.locator("canvas[data-engine]").bounding_box()
    fov, aspect, up = math.radians(FIELD_DEG), box["width"] / box["height"], np.array([0.0, 0.0, 1.0])
    centre = (STANDS.min(axis=0) + STANDS.max(axis=0)) / 2
    back = DIRECTIONS["reset"] / np.linalg.norm(DIRECTIONS["reset"])
    eye = centre + FIT_MARGIN * fit_distance_m(STANDS, centre, back, up, fov, aspect) * back
    right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
    x, y, z = np.array([right, -np.cross(back, right), -back]) @ (np.array(p_W) - eye)
    focal_px = box["height"] / 2 / math.tan(fov / 2)
    return (
        box["x"] + box["width"] / 2 + focal_px * float(x / z),
        box["y"] + box["height"] / 2 + focal_px * float(y / z),
    )


def click(page: BrowserPage, camera: str) -> None:
    page.page.locator(f'[data-camera="{camera}"]').click()


def watched(page: BrowserPage) -> list[str]:
    return [each["camera"] for each in page.state().get("cameras", ()) if each["watched"]]


def repeated(client: Client, key: str, payload: bytes) -> AbstractContextManager[None]:
    """Publish the same bytes repeatedly while the context is open."""
    return meanwhile(lambda: client.put_raw(key, payload), 0.01)


@needs_browser
@pytest.mark.slow
@pytest.mark.soak
def test_pictures_and_drones_are_shown_on_a_reloaded_page(
    federation: Federation, opened: Callable[..., BrowserPage]
) -> None:
    pytest.importorskip("cv2", reason="pip install opencv-python-headless")
    federation.world(ALONE, "--duration", "600", "--rate", "1")
    role, links = console(federation)
    role.line("console.1: in run")
    cameras = [f"drone1/{name}" for name in SETTINGS]
    with synthetic_camera.published(federation.client(), ["drone1"], rate_hz=5.0):
        page = opened(links["steer"], LOW, drawn=True)
        until(page, lambda: numbers(page), lambda seen: list(seen) == cameras and None not in seen.values())
        page.page.reload()
        wait_for_pictures_and_drones(page, cameras)


@needs_browser
@pytest.mark.slow
@pytest.mark.soak
def test_camera_pictures_are_shown_below_the_scene(federation: Federation, opened: Callable[..., BrowserPage]) -> None:
    pytest.importorskip("cv2", reason="pip install opencv-python-headless")
    federation.run(TRIAD, "--rate", "1")
    _, links = console(federation)
    client = federation.client()
    page = opened(links["steer"], LAPTOP, drawn=True)
    page.until("s.drones.length == 3 && s.clock == 'running'")
    strip = page.page.locator("#zsim-cameras")

    # a run without cameras shows no pictures
    assert page.state()["cameras"] == []
    assert not strip.is_visible()

    with synthetic_camera.published(client, THREE, seen_by=["drone1"]):
        # all six pictures appear and are updated
        strip.wait_for(state="visible")
        wait_until_all_change(page, SIX)

        # a sighting is marked at its place in the picture, with its range
        u, v, text = until(page, lambda: page.page.evaluate(MARK), lambda seen: seen is not None)
        expected = synthetic_camera.projected("front", synthetic_camera.HAT_B)
        assert (u * 640 - 0.5, v * 360 - 0.5) == pytest.approx(expected, abs=1.5)
        assert text == "6.1 ± 0.2 m"
        assert page.page.locator("#zsim-cameras circle").count() == 1

        # nothing is cut off or covered; the scene ends where the pictures begin
        page.page.locator(".mantine-Notification-closeButton").click()  # the "software WebGL" notice of this browser
        for screen in SCREENS:
            page.page.set_viewport_size(screen)
            until(page, lambda: page.page.evaluate(COVERED), lambda seen: seen == [])
            until(page, lambda: page.page.evaluate(CUT_TEXTS), lambda seen: seen == [])
            until(page, lambda: page.page.evaluate(PLACES), lambda seen, screen=screen: is_stacked(seen, screen))
        page.page.set_viewport_size(LAPTOP)

        # one click shows the frustum with its picture, another hides it
        until(page, lambda: sky_pixels(page), lambda seen: seen < SKY_PIXELS)  # laid out for the laptop again
        click(page, "drone2/front")
        until(page, lambda: sky_pixels(page), lambda seen: seen > SKY_PIXELS)
        assert page.page.locator("#zsim-cameras [aria-pressed=true]").get_attribute("data-camera") == "drone2/front"
        click(page, "drone2/front")
        until(page, lambda: sky_pixels(page), lambda seen: seen < SKY_PIXELS)

        # a click on the drone in the scene does the same
        page.page.mouse.click(*place_of(page, (-1.5, -1.5, 0.0)))
        until(page, lambda: sky_pixels(page), lambda seen: seen > SKY_PIXELS)
        assert page.page.locator("#zsim-cameras [aria-pressed=true]").get_attribute("data-camera") == "drone2/front"
        click(page, "drone2/front")

        # an invalid picture is counted and affects no other
        with repeated(client, "drone/drone3/camera/front", b"no message at all"):
            page.until("s.cameras.find(c => c.camera == 'drone3/front').refused > 0")
        info = synthetic_camera.image_message("bottom", 1, b"no JPEG", 0)
        with repeated(client, "drone/drone3/camera/bottom", messages.encode(info)):
            page.until("s.cameras.find(c => c.camera == 'drone3/bottom').reason.includes('JPEG')")
        wait_until_all_change(page, SIX)

        # a page that shows no pictures is sent none
        page.press("Cameras ▾")
        until(page, lambda: watched(page), lambda seen: seen == [])
        until(
            page,
            lambda: page.page.evaluate(PLACES)[0]["height"],
            lambda seen: abs(seen + HEAD_PX - LAPTOP["height"]) < 1.5,
        )
        page.press("Cameras ▴")
        wait_until_all_change(page, SIX)

    assert page.outside() == set()
    assert page.faults == []


@needs_browser
@pytest.mark.soak
def test_a_viewer_sees_the_camera_pictures(federation: Federation, opened: Callable[..., BrowserPage]) -> None:
    pytest.importorskip("cv2", reason="pip install opencv-python-headless")
    federation.run(TRIAD, "--rate", "1")
    _, links = console(federation, "--token", "a-good-token")
    client = federation.client()
    viewer = opened(links["look"], LAPTOP, drawn=True)
    with synthetic_camera.published(client, THREE):
        wait_until_all_change(viewer, SIX)
        viewer.page.locator(".mantine-Notification-closeButton").click()
        click(viewer, "drone2/front")
        until(viewer, lambda: sky_pixels(viewer), lambda seen: seen > SKY_PIXELS)
    assert viewer.outside() == set()
    assert viewer.faults == []


@needs_browser
@pytest.mark.soak
def test_the_drones_whose_pictures_are_shown_can_be_chosen(
    federation: Federation, opened: Callable[..., BrowserPage]
) -> None:
    pytest.importorskip("cv2", reason="pip install opencv-python-headless")
    federation.world(TWELVE, "--duration", "600")
    role, links = console(federation)
    role.line("console.1: in run")
    client = federation.client()
    page = opened(links["steer"], LAPTOP)
    with synthetic_camera.published(client, [f"drone{k + 1}" for k in range(12)], rate_hz=5.0):
        wait_until_all_change(page, SIX)  # there is room for three drones
        assert sorted(watched(page)) == sorted(SIX)
        page.page.get_by_label("drone of window 2").select_option("drone11")
        now = [f"{drone}/{name}" for drone in ("drone1", "drone11", "drone3") for name in SETTINGS]
        wait_until_all_change(page, now)
        until(page, lambda: sorted(watched(page)), lambda seen: seen == sorted(now))
        for screen in SCREENS:
            page.page.set_viewport_size(screen)
            until(page, lambda: page.page.evaluate(COVERED), lambda seen: seen == [])
    page.page.close()
    assert page.faults == []


def test_pictures_require_the_token_of_their_page(federation: Federation) -> None:
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    _, links = console(federation, "--token", "a-good-token")
    port = links["steer"].split(":")[2].split("/")[0]
    for path in ("/cameras", "/view/cameras", "/cameras?token=wrong"):
        with pytest.raises(InvalidStatus) as refusal:
            connect(f"ws://127.0.0.1:{port}{path}")
        assert refusal.value.response.status_code == 401
    look = links["look"].partition("token=")[2]
    with pytest.raises(InvalidStatus):
        connect(f"ws://127.0.0.1:{port}/cameras?token={look}")
    connect(f"ws://127.0.0.1:{port}/view/cameras?token={look}").close()
    connect(f"ws://127.0.0.1:{port}/cameras?token=a-good-token").close()


def test_an_invalid_request_closes_the_connection(federation: Federation) -> None:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    _, links = console(federation)
    for said in (b"\x00", "no JSON", "[]", '{"want": 3}', '{"want": ["' + "x" * 100 + '"]}', '{"steer": true}'):
        with connect(f"{links['steer'].replace('http', 'ws')}cameras") as socket:
            socket.send(said)
            with pytest.raises(ConnectionClosed):
                socket.recv(timeout=PATIENCE_S)


def test_pictures_are_forwarded_unchanged(federation: Federation) -> None:
    pytest.importorskip("cv2", reason="pip install opencv-python-headless")
    from websockets.sync.client import connect

    federation.world(TRIAD, "--duration", "600")
    role, links = console(federation)
    role.line("console.1: in run")
    client = federation.client()
    made = synthetic_camera.picture("front", 3)
    message = messages.encode(synthetic_camera.image_message("front", 3, made, 7_000_000_000))
    info = messages.encode(synthetic_camera.info_of("front"))
    with (
        repeated(client, keys.camera_info("drone2", "front"), info),
        repeated(client, keys.camera("drone2", "front"), message),
        connect(f"{links['steer'].replace('http', 'ws')}cameras") as socket,
    ):
        until_s = time.monotonic() + PATIENCE_S
        while True:
            assert time.monotonic() < until_s
            socket.send('{"want": ["drone2/front"]}')
            received: Any = socket.recv(timeout=PATIENCE_S)
            size = int.from_bytes(received[:4], "big")
            header = msgspec.json.decode(received[4 : 4 + size])
            if header["pictures"]:
                break
    assert header["pictures"] == [{"camera": "drone2/front", "size": len(made), "t_s": 7.0, "marks": []}]
    assert received[4 + size :] == made
