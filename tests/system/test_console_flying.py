"""One drone flown from a page, by hand with a dead-man key and to a place on the map; a viewer cannot fly it."""

from collections.abc import Callable
from typing import Any

import pytest
from chromium import needs_browser
from console_browser import SCREENS, BrowserPage, console
from federation import Federation
from test_console import TRIAD

FLOWN = 1  # index of drone2
STICK_S = 3.0  # simulated time for which a key is held
BESIDE_M = 1.5  # distance from a drone at which a click misses it but is still on the map
MOVED_M = 1.0  # farther than the wind moves a hovering drone
SETTLE_S = 3.0  # simulated time in which a drone comes to rest
BAR = "document.querySelector('#zsim-flight .bar').dataset.state"
SEES = "() => { const view = document.getElementById('zsim-map').dataset.view; return view && JSON.parse(view); }"


def place(state: dict[str, Any]) -> list[float]:
    return state["drones"][FLOWN]["position_m"]


def after(page: BrowserPage, seconds: float) -> list[float]:
    """Return the drone's position after some simulated time."""
    return place(page.until(f"s.t_s > {page.state()['t_s'] + seconds}"))


def is_near(x_m: float, y_m: float) -> str:
    """Return a condition for the page: the drone is near a place."""
    return f"Math.hypot(s.drones[{FLOWN}].position_m[0] - {x_m}, s.drones[{FLOWN}].position_m[1] - {y_m}) < 0.7"


def click_map(page: BrowserPage, x_m: float, y_m: float) -> None:
    """Click a place [m; W] on the map."""
    view = page.page.evaluate(SEES)
    box = page.page.locator("#zsim-map canvas").bounding_box()
    assert box is not None
    dx, dy = (x_m - view["x"]) * view["scale"], (view["y"] - y_m) * view["scale"]
    assert abs(dx) < box["width"] / 2, "beside the map"
    assert abs(dy) < box["height"] / 2, "beside the map"
    page.page.mouse.click(box["x"] + box["width"] / 2 + dx, box["y"] + box["height"] / 2 + dy)


@needs_browser
@pytest.mark.slow
@pytest.mark.soak
def test_a_drone_is_flown_by_hand_and_to_a_place(federation: Federation, opened: Callable[..., BrowserPage]) -> None:
    federation.run(TRIAD, "--rate", "2")
    _, links = console(federation)
    operator, viewer = opened(links["steer"], SCREENS[1]), opened(links["look"], SCREENS[1])
    bar = operator.page.locator("#zsim-flight")
    operator.page.get_by_role("button", name="Take off", exact=True).and_(operator.page.locator(":enabled")).click()
    operator.until("s.clusters[0].reason == 'ready to engage'")

    # a viewer has the map, but no flight controls
    viewer.page.locator("#zsim-flight .map").click()
    viewer.page.wait_for_function(SEES)
    assert viewer.page.locator("#zsim-flight .fly").is_hidden()
    x_m, y_m, _ = place(viewer.state())
    click_map(viewer, x_m + BESIDE_M, y_m + BESIDE_M)
    viewer.page.locator("#zsim-map .there").wait_for()
    assert viewer.page.locator("#zsim-map .go").is_hidden()
    viewer.page.close()

    # a click on a drone chooses it
    bar.locator(".map").click()
    operator.page.wait_for_function(SEES)
    click_map(operator, *place(operator.state())[:2])
    bar.locator(".fly").click()
    bar.locator(".take").get_by_text("drone2").wait_for()

    # manual flight is refused while the controller flies the drone, until the operator takes over
    bar.locator(".take").click()
    bar.locator(".over").wait_for()
    with operator.held("#zsim-flight .over"):
        bar.locator(".leave").wait_for()

    # nothing moves without the dead-man key; with it, forward is where the nose points, here north
    operator.page.keyboard.down("KeyW")
    start = after(operator, STICK_S)
    assert operator.page.evaluate(BAR) == "flying"
    operator.page.keyboard.down("Shift")
    operator.page.wait_for_function(f"() => {BAR} === 'held'")
    operator.page.keyboard.down("KeyW")  # repeated, as by a held key: the page may have lost the focus for a moment
    there = place(operator.until(f"s.drones[{FLOWN}].position_m[1] > {start[1] + MOVED_M}"))
    assert abs(there[0] - start[0]) < 0.5 * (there[1] - start[1])

    # the drone hovers once the page loses the focus
    operator.page.evaluate("dispatchEvent(new Event('blur'))")
    operator.page.wait_for_function(f"() => {BAR} === 'flying'")
    rest = after(operator, SETTLE_S)
    assert abs(after(operator, STICK_S)[1] - rest[1]) < 0.5
    operator.page.keyboard.up("Shift")
    operator.page.keyboard.up("KeyW")

    # the drone flies to places at its own height; a place outside the fence is not offered
    goal = (round(rest[0] - 1.0, 1), round(rest[1] + 1.0, 1))
    click_map(operator, *goal)
    operator.page.locator("#zsim-map .go").click()
    arrived = operator.until(is_near(*goal))
    assert abs(place(arrived)[2] - rest[2]) < 0.7
    after_it = (goal[0] - BESIDE_M, goal[1] - BESIDE_M)
    click_map(operator, *after_it)
    operator.page.locator("#zsim-map .then").click()
    operator.until(is_near(*after_it))
    operator.page.locator("#zsim-map canvas").hover()
    operator.page.mouse.wheel(0, 10_000)
    operator.page.wait_for_function(f"() => ({SEES})().scale < 1")
    click_map(operator, 0.0, 120.0)
    operator.page.locator("#zsim-map .there").wait_for()
    assert operator.page.locator("#zsim-map .go").is_hidden()

    # the operator gives the drone back
    bar.locator(".leave").click()
    bar.locator(".take").wait_for()
    assert operator.outside() == set()
    assert operator.faults == []
