"""Thirty drones on a page: sorted, filtered and selected for one command, on a laptop and on a phone."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import needs_browser
from console_browser import IN_SIGHT, POLL_MS, SCREENS, BrowserPage
from staged_console import StagedRun, staged_console
from wire import PATIENCE_S

pytestmark = [
    needs_browser,
    pytest.mark.soak,
]

GRID = Path(__file__).parents[2] / "scenarios" / "grid30.yaml"
DRAWN_HZ = 10.0  # a console's picture rate for thirty drones
TOUCH_PX = 44  # least size of a touch target, WCAG 2.2, 2.5.5
CELL_JS = """([drone, cell]) => {
  const row = document.querySelector(`[data-zsim-drone=${drone}]`), box = row.children[cell].getBoundingClientRect();
  row.scrollIntoView({ block: "center" });
  const there = row.children[cell].getBoundingClientRect();
  return [there.x + there.width / 2, there.y + there.height / 2];
}"""
ROWS_JS = (
    "() => [...document.querySelectorAll('[data-zsim-drone]:has(.zsim-select)')].map(row => row.dataset.zsimDrone)"
)
SMALL_JS = f"""() => [...document.querySelectorAll("button, select, input, [role=tab], .zsim-select")].filter(each => {{
  const box = each.getBoundingClientRect(), {{ left, top, width, height }} = box;
  if (!each.checkVisibility({{ opacityProperty: false, visibilityProperty: true }}) || width < 2 || each.type === "range") return false;
  const hit = document.elementFromPoint(left + width / 2, top + height / 2);
  if (!hit || !(each.contains(hit) || hit.contains(each))) return false;  // scrolled out of sight
  return height < {TOUCH_PX} - .5 || (!each.textContent.trim() && width < {TOUCH_PX} - .5);
}}).map(each => `${{each.tagName}}.${{each.className}} '${{each.textContent.trim()}}' ${{JSON.stringify(each.getBoundingClientRect())}}`)"""
BARS_JS = """() => {
  const shown = [...document.querySelectorAll("#zsim-head, #zsim-tools, #zsim-flight > *, #zsim-record, #zsim-age, #zsim-map .fit," +
    " .zsim-sheet, .mantine-Notification-root")].filter(each => each.checkVisibility()).map(each => [each, each.getBoundingClientRect()]);
  const found = [];
  for (const [a, p] of shown) for (const [b, q] of shown) {
    if (a === b || a.compareDocumentPosition(b) & Node.DOCUMENT_POSITION_PRECEDING) continue;
    if (Math.min(p.right, q.right) - Math.max(p.left, q.left) > 1 && Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top) > 1)
      found.push(`${a.id || a.className} and ${b.id || b.className}`);
  }
  return found;
}"""
"""Returns pairs of overlapping bars."""
DRONES_JS = """() => {
  const view = JSON.parse(document.getElementById("zsim-map").dataset.view ?? "null");
  if (!view) return ["not drawn yet"];
  const canvas = document.querySelector("#zsim-map canvas").getBoundingClientRect();
  return [[-8.75, 7], [8.75, 7], [-8.75, -7], [8.75, -7]].filter(([x, y]) => {
    const px = canvas.x + canvas.width / 2 + (x + 5 - view.x) * view.scale, py = canvas.y + canvas.height / 2 - (y - view.y) * view.scale;
    return document.elementFromPoint(px, py)?.tagName !== "CANVAS";
  });
}"""
"""Returns the corners of the grid, which is centred on (5, 0) m, that something covers on the map."""


def until_nothing(page: BrowserPage, faults: str) -> None:
    """Wait until a JavaScript function finds no fault in a page."""
    until_s = time.monotonic() + PATIENCE_S
    while found := page.page.evaluate(faults):
        assert time.monotonic() < until_s, found
        page.page.wait_for_timeout(POLL_MS)


def wait_for(page: BrowserPage, count: int, of: Callable[[], list[Any]]) -> None:
    """Wait until `of` returns at least `count` items."""
    until_s = time.monotonic() + PATIENCE_S
    while len(of()) < count:
        assert time.monotonic() < until_s, of()
        page.page.wait_for_timeout(POLL_MS)


@pytest.fixture(scope="module")
def fleet() -> Iterator[tuple[StagedRun, str]]:
    run = StagedRun(past_s=10.0, scenario=GRID)
    run.percent_of = {"drone17": 8.0, "drone4": 15.0}
    with staged_console(run, hz=DRAWN_HZ) as address:
        yield run, address


def rows(page: BrowserPage) -> list[str]:
    return page.page.evaluate(ROWS_JS)


def tap(page: BrowserPage, drone: str, cell: int) -> None:
    page.page.mouse.click(*page.page.evaluate(CELL_JS, [drone, cell]))


def field(page: BrowserPage, label: str) -> Any:
    """Return the input field that a label names."""
    named = page.page.get_by_text(label, exact=True).and_(page.page.locator(":visible")).first
    return named.locator("xpath=ancestor::div[.//input][1]").locator("input").last


def choose(page: BrowserPage, label: str, option: str) -> None:
    page.page.get_by_label(label, exact=True).first.click()
    page.page.get_by_role("option", name=option, exact=True).click()


def test_thirty_drones_are_sorted_filtered_and_commanded_together(
    fleet: tuple[StagedRun, str], opened: Callable[..., BrowserPage]
) -> None:
    run, address = fleet
    page = opened(address, SCREENS[1])
    page.page.wait_for_function(f"() => ({ROWS_JS})().length === 30")
    page.page.wait_for_function(f"() => ({ROWS_JS})().slice(0, 2).join() === 'drone17,drone4'")  # worst first
    choose(page, "sort by", "as in the scenario")
    page.page.wait_for_function(f"() => ({ROWS_JS})()[0] === 'drone1'")
    field(page, "filter").fill("drone2")
    page.page.wait_for_function(f"() => ({ROWS_JS})().length === 11")  # drone2, and drone20 to drone29

    # a click on a row chooses the drone, one on its box selects it; a command goes to all selected drones
    tap(page, "drone20", 1)
    page.page.locator("[data-zsim-chosen][data-zsim-drone=drone20]").first.wait_for()
    page.page.locator(".zsim-instruments").wait_for()
    tap(page, "drone21", 0)
    tap(page, "drone29", 0)
    land = page.page.get_by_role("button", name="Land 2 drones", exact=True)
    land.wait_for()
    run.link.asked.clear()
    land.click()
    page.page.wait_for_function(f"() => ({ROWS_JS})().length === 11")
    acquired = lambda: [args["drone"] for op, args in list(run.link.asked) if op == "acquire"]  # noqa: E731
    wait_for(page, 2, acquired)
    assert sorted(acquired()) == ["drone21", "drone29"]

    # a target is previewed before it is flown
    page.page.get_by_label("Preview first").check()
    number = field(page, "x_c [m]")
    page.page.locator("#zsim-flight .map").click()
    run.link.asked.clear()
    number.fill("9")
    number.press("Enter")
    fly = page.page.get_by_role("button", name="Fly the preview", exact=True)
    fly.wait_for()
    page.page.wait_for_function("() => Number(document.getElementById('zsim-map').dataset.previews) === 30")
    targets = lambda: [args for op, args in list(run.link.asked) if op == "target"]  # noqa: E731
    assert targets() == []
    fly.click()
    wait_for(page, 1, targets)
    assert targets() == [{"values": {"x_c": 9.0}}]
    page.page.wait_for_function("() => Number(document.getElementById('zsim-map').dataset.previews) === 0")
    page.page.get_by_label("Preview first").uncheck()

    # the formation returns, first to above the centre of its starting positions
    run.link.asked.clear()
    page.press("Return")
    wait_for(page, 1, targets)
    assert targets()[0] == {"values": {"x_c": 0.0, "y_c": 0.0}}
    assert page.faults == []


def test_on_a_phone_controls_are_large_enough_and_nothing_is_covered(
    fleet: tuple[StagedRun, str], opened: Callable[..., BrowserPage]
) -> None:
    _, address = fleet
    page = opened(address, SCREENS[-1])
    page.wait_for_text("running")
    page.wait_for_notice()
    until_nothing(page, BARS_JS)
    page.close_notice()
    found: dict[str, Any] = {}
    for tab in ("Fly", "Plots", "Faults", "Run", "Drones", "Events"):
        page.select_tab(tab)
        page.open_folders()
        page.page.wait_for_timeout(500)  # until the folders are open
        if small := page.page.evaluate(SMALL_JS):
            found[tab] = small
    assert found == {}
    for button in (".map", ".fly"):
        page.page.locator(f"#zsim-flight {button}").click()
    until_nothing(page, BARS_JS)
    until_nothing(page, DRONES_JS)
    assert page.page.evaluate(SMALL_JS) == []
    assert page.page.evaluate(IN_SIGHT)
