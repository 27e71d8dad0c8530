"""Orders that must not be lost, confirmations, ages and limits, in a browser while page, console or world stalls."""

import json
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from chromium import needs_browser
from console_browser import IN_SIGHT, PATIENCE_MS, PICTURES, POLL_MS, BrowserPage, console, opening
from federation import Federation
from page_overflow import overflow
from staged_console import StagedRun, staged_console
from test_console import TRIAD, states
from test_console_flying import SEES, click_map
from wire import PATIENCE_S

pytestmark = needs_browser

SIZES = ({"width": 1440, "height": 900}, {"width": 1024, "height": 768}, {"width": 390, "height": 844})
LATE_MS, LOST_MS = 1000, 3000  # ages at which the page marks data as old and as lost
STALL_MS = 3500  # stall of the page; above LOST_MS
PAST_S = 5.0  # past of the staged run, which no test examines
REST_MS = 1500  # time after which the values of resting sliders have been sent; above REST_S
STALL_JS = "ms => { const until = performance.now() + ms; while (performance.now() < until); }"
ROW = "#zsim-orders [data-state={}]"
BAR = "document.querySelector('#zsim-flight .bar').dataset.state"
MARKER_JS = "() => JSON.parse(document.getElementById('zsim-map').dataset.marker || 'null')"


def picture(page: BrowserPage, name: str) -> None:
    """Save screenshots of a page at all sizes for inspection, if a folder is given."""
    if PICTURES:
        for size in SIZES:
            page.page.set_viewport_size(size)
            page.page.wait_for_timeout(LATE_MS)
            page.page.screenshot(path=f"{PICTURES}/{name}-{size['width']}.png", timeout=PATIENCE_MS)
        page.page.set_viewport_size(SIZES[1])


def note(page: BrowserPage, text: str) -> None:
    """Wait for a note on the page."""
    page.page.locator("#zsim-notes div").filter(has_text=text).first.wait_for()


def row(page: BrowserPage, state: str, *terms: str) -> str:
    """Wait for the row of an order that is in a state and contains terms; return its text."""
    found = page.page.locator(ROW.format(state))
    for term in terms:
        found = found.filter(has_text=term)
    found.first.wait_for()
    return str(found.first.text_content())


@pytest.mark.slow
def test_no_order_is_lost_when_page_console_or_world_stalls(
    federation: Federation, opened: Callable[..., BrowserPage]
) -> None:
    federation.run(TRIAD, "--rate", "1")
    role, links = console(federation)
    page = opened(links["steer"], SIZES[1])
    head = page.page.locator("#zsim-head")
    page.page.get_by_role("button", name="Take off", exact=True).and_(page.page.locator(":enabled")).click()
    page.until("s.clusters[0].reason == 'ready to engage'")

    # a long press, on a button that names both, takes a drone over from its controller
    page.page.locator("#zsim-flight .fly").click()
    page.page.locator("#zsim-flight .take").get_by_text("drone1").click()
    over = page.page.locator("#zsim-flight .over")
    over.wait_for()
    assert "drone1" in str(over.text_content())
    assert "controller.main" in str(over.text_content())
    over.click()  # too short a press
    note(page, "hold it")
    with page.held("#zsim-flight .over"):
        page.page.wait_for_function(f"() => {BAR} === 'flying'")

    # the console stalls: the page no longer shows the flight as live, and the order waits in red, with its age
    role.signal(signal.SIGSTOP)
    page.page.wait_for_function(f"() => ['old', 'lost'].includes({BAR})")
    head.locator(".land").click()
    row(page, "sent", "Land all", "not confirmed", "the console does not answer")
    page.page.wait_for_function(f"() => {BAR} === 'lost'")
    page.page.locator("#zsim-head[data-level=gone]").wait_for()
    assert head.locator(".land").is_enabled()
    assert head.locator(".emergency").is_enabled()
    page.page.locator("[data-zsim-order=land][data-cluster=main]").and_(page.page.locator(":enabled")).wait_for()
    picture(page, "stopped-console")
    assert page.page.evaluate(IN_SIGHT)
    role.signal(signal.SIGCONT)
    note(page, "the console stood still")
    assert "confirmed at" in row(page, "confirmed", "Land all")
    page.until("s.events.some(e => e.text == 'main: land: accepted')")
    landings = [event for event in page.state()["events"] if event["text"] == "main: land: accepted"]
    assert len(landings) == 1
    page.page.wait_for_function(f"() => !['held', 'flying', 'old', 'lost'].includes({BAR})")

    # the page stalls: it reports itself, not the console
    page.page.evaluate(STALL_JS, STALL_MS)
    note(page, "this page stood still")
    assert head.get_attribute("data-level") != "gone"
    assert head.locator(".emergency").is_enabled()

    # the world stalls: the keyboard orders an emergency
    federation.kill("world", signal.SIGSTOP)
    page.page.locator("#zsim-head[data-level=silent]").wait_for()
    emergency = head.locator(".emergency")
    emergency.focus()
    page.page.keyboard.press("Enter")
    note(page, "hold it")
    assert page.page.locator(ROW.format("sent")).count() == 0
    page.page.keyboard.down("Enter")
    row(page, "sent", "EMERGENCY all", "not confirmed", "the world has not answered")
    page.page.keyboard.up("Enter")
    assert emergency.is_enabled()
    picture(page, "stopped-world")
    federation.kill("world", signal.SIGCONT)
    assert "confirmed at" in row(page, "confirmed", "EMERGENCY all")
    assert states(page.until("s.drones.every(d => d.state == 'emergency')")) == ["emergency"] * 3
    assert page.outside() == set()
    assert page.faults == []


@pytest.fixture(scope="module")
def staged(browser: Any) -> Iterator[tuple[StagedRun, BrowserPage]]:
    """A run and a page of it, which the tests of this file share; each test leaves both as they were."""
    run = StagedRun(past_s=PAST_S)
    with staged_console(run) as address, opening(browser) as open_it:
        page = open_it(address, SIZES[1])
        page.wait_for_text("running")
        yield run, page


def asked(run: StagedRun, op: str) -> list[dict[str, Any]]:
    return [args for each, args in run.link.asked if each == op]


def wait_for(page: BrowserPage, count: int, of: Callable[[], list[Any]]) -> None:
    """Wait until `of` returns at least `count` items."""
    until_s = time.monotonic() + PATIENCE_S
    while len(of()) < count:
        assert time.monotonic() < until_s, of()
        page.page.wait_for_timeout(POLL_MS)


@pytest.mark.slow
def test_a_typed_value_is_requested_or_refused_but_never_clamped(
    staged: tuple[StagedRun, BrowserPage],
) -> None:
    run, page = staged
    for place, name, typed, limit in ((0, "x_c", "100", "50"), (2, "z_c", "300", "30")):
        field = page.page.locator(".mantine-Slider-root + * input").nth(place)
        field.fill(typed)
        field.blur()
        page.page.get_by_text(f"{name} is {typed} m; must be from").first.wait_for()
        assert limit in str(page.page.get_by_text(f"{name} is {typed} m; must be from").first.text_content())
    page.page.wait_for_timeout(REST_MS)
    assert asked(run, "target") == []
    field = page.page.locator(".mantine-Slider-root + * input").nth(0)
    field.fill("7.5")
    field.blur()
    wait_for(page, 1, lambda: [args for args in asked(run, "target") if args["values"] == {"x_c": 7.5}])
    assert not any(args["values"]["x_c"] >= 50 for args in asked(run, "target"))

    page.select_tab("Run")
    page.page.get_by_text("rate: 0 to").wait_for()
    rate = page.page.get_by_label("rate", exact=True).or_(page.page.locator("input[inputmode]").nth(1)).last
    rate.fill("-1")
    rate.blur()
    page.press("Set rate")
    wait_for(page, 1, lambda: asked(run, "rate"))
    assert asked(run, "rate") == [{"value": -1.0}]
    picture(page, "limits")
    page.select_tab("Fly")


@pytest.mark.slow
def test_a_confirmation_names_drone_place_and_height_and_its_marker_stays(
    staged: tuple[StagedRun, BrowserPage],
) -> None:
    run, page = staged
    page.page.locator("#zsim-flight .map").click()
    page.page.wait_for_function(SEES)
    run.commander = "controller.main"
    state = page.until("s.drones.length == 3")
    x, y, z = state["drones"][0]["position_m"]
    click_map(page, x + 1.7, y - 1.7)
    there = page.page.locator("#zsim-map .there")
    there.wait_for()
    page.page.wait_for_function(MARKER_JS)
    marker = page.page.evaluate(MARKER_JS)
    assert marker["drone"] == "drone1"
    text = str(there.locator("span").text_content()).replace("\N{MINUS SIGN}", "-")
    assert all(part in text for part in ("drone1", f"x {marker['x']:.1f} m", f"y {marker['y']:.1f} m", "height"))
    assert marker["z"] == pytest.approx(z, abs=0.2)
    assert overflow(page.page) == []
    picture(page, "confirm-place")
    view = page.page.evaluate(SEES)
    page.until(f"s.t_s > {state['t_s'] + 3.0}")  # the drones move
    assert page.page.evaluate(MARKER_JS) == marker
    assert page.page.evaluate(SEES) == view

    # the process that flies the drone is named, and only a long press takes the drone over
    there.locator(".go").click()
    there.get_by_text("controller.main").wait_for()
    assert "drone1" in str(there.locator(".go").text_content())
    there.locator(".go").click()
    page.page.wait_for_timeout(LATE_MS)
    assert asked(run, "acquire") == []
    picture(page, "confirm-over")
    with page.held("#zsim-map .there .go"):
        wait_for(page, 1, lambda: asked(run, "acquire"))
    run.commander = "console.1"
    page.page.locator("#zsim-flight .text").get_by_text("goes to").wait_for()
    assert [args["drone"] for args in asked(run, "acquire")] == ["drone1"]
    flown = page.page.evaluate(MARKER_JS)
    assert (flown["x"], flown["y"], flown["z"]) == (marker["x"], marker["y"], marker["z"])
    page.page.locator("#zsim-flight .leave").click()
    page.page.locator("#zsim-flight .map").click()
    run.commander = None


@pytest.mark.slow
def test_a_repeated_order_is_carried_out_once(
    staged: tuple[StagedRun, BrowserPage],
) -> None:
    run, page = staged
    bodies: list[dict[str, Any]] = []

    def lose(route: Any) -> None:
        """Forward an order, but withhold the answer three times."""
        bodies.append(json.loads(route.request.post_data))
        if len(bodies) <= 3:
            route.fetch()
            route.abort()
        else:
            route.continue_()

    page.page.route("**/command", lose)
    page.page.route("**/head", lambda route: route.abort())  # it reports orders too
    held = len(asked(run, "hold"))
    page.page.locator("[data-zsim-order=hold]").click()
    assert "confirmed at" in row(page, "confirmed", "Hold main")
    assert len(bodies) == 4
    assert len({body["id"] for body in bodies}) == 1
    assert len(asked(run, "hold")) == held + 1
    page.page.unroute_all()
