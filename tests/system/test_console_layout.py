"""Every panel of the console on the screens of a desktop, a laptop and a phone."""

import time
from collections.abc import Callable, Iterator

import pytest
from chromium import needs_browser
from console_browser import IN_SIGHT, SCREENS, BrowserPage
from page_overflow import overflow
from staged_console import StagedRun, staged_console
from wire import PATIENCE_S

pytestmark = needs_browser

LOOK_MS = 250  # polling interval for a page that is being laid out
TIMELINE = {"from_s": 0.0, "to_s": 400.0, "marks": [{"t_s": 20.0, "kind": "mode", "text": "take off"}]}
FORMS, TABLES = ("Fly", "Plots", "Faults", "Run"), ("Drones", "Events")
LONG = "link_loss of drone1/estimator.drone1 begins with a probability of 0.3, as was asked for by console.1"
COVERED_JS = """() => {
  const canvas = document.querySelector("canvas[data-engine]").getBoundingClientRect();
  const at = (x, y) => document.elementFromPoint(canvas.left + x * canvas.width, canvas.top + y * canvas.height);
  const free = [.2, .4, .6, .8].flatMap(x => [.3, .5, .7].map(y => at(x, y)?.closest("canvas") !== null));
  return { width: canvas.width, height: canvas.height, free: free.filter(Boolean).length / free.length };
}"""
"""Returns the scene's size, and the share of its middle that nothing covers."""
CURVES_JS = """() => [...document.querySelectorAll(".uplot canvas")].map(canvas => {
  if (!canvas.width) return [0, 0];  // not laid out yet
  const points = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  const colours = [[25, 113, 194], [232, 89, 12]];
  const near = (i, colour) => points[i + 3] > 128 && colour.every((value, k) => Math.abs(points[i + k] - value) < 24);
  return colours.map(colour => {
    let count = 0;
    for (let i = 0; i < points.length; i += 4) count += near(i, colour);
    return count;
  });
})"""
"""Returns, for each plot, how many pixels have the colours of the estimated and of the true curve."""
LIT = ["#zsim-head", "label", "table td"]
LIGHTNESS_JS = """selectors => selectors.flatMap(selector => {
  const lightness = colour => { const [r, g, b] = colour.match(/[\\d.]+/g).map(Number); return (r + g + b) / 765; };
  const element = [...document.querySelectorAll(selector)].find(each => each.checkVisibility());
  if (!element) return [];
  let behind = element;
  const clear = each => / 0\\)/.test(getComputedStyle(each).backgroundColor);
  while (clear(behind) && behind.parentElement) behind = behind.parentElement;
  return [[lightness(getComputedStyle(behind).backgroundColor), lightness(getComputedStyle(element).color)]];
})"""
"""Returns the lightness, from 0 to 1, of the background and the text of parts of the page."""
CURVE_PX = 100  # least number of a curve's pixels across a plot; the legend is not on the canvas
DRAWN_JS = (
    f"() => {{ const found = ({CURVES_JS})(); return found.length === 3 && found.every(c => c[1] > {CURVE_PX}); }}"
)
SIZES_JS = "() => [...document.querySelectorAll('.uplot')].map(each => [each.offsetWidth, each.offsetHeight])"
KINDS_CUT_JS = """() => [...document.querySelectorAll("[data-zsim-event]")].map(row => row.children[1])
  .filter(kind => kind.scrollWidth > kind.clientWidth || getComputedStyle(kind).textOverflow === "ellipsis").length"""
UNFOLDED_JS = """() => {
  const text = document.querySelector(".zsim-event-text");
  return text.scrollHeight <= text.clientHeight + 1;
}"""
GRID_CONTRAST = 0.03  # least contrast of the ground with its whole grid; parts of the grid give 0.02, none of it 0.005
ZOOMS, ZOOM_PX = 4, 150  # zoom steps away from the drones, which are 15 m up, and wheel pixels per step
DRAWN_MS = 1000  # time in which a page without a graphics card has rendered a zoom
LOW = {"width": 1280, "height": 560}  # so low that the panel of drones has a scroll bar
DRAIN_PERCENT_S = 0.06  # of a battery that lasts about as long as the AR.Drone's
WIDTHS_JS = "() => [...document.querySelectorAll('.uplot-container')].map(each => each.offsetWidth)"


@pytest.fixture(scope="module")
def flight() -> Iterator[str]:
    run = StagedRun()
    with staged_console(run) as address:
        run.happen("superseded", "estimator.drone1", "another one has its name")
        run.happen("fault", "drone1", LONG)
        yield address


@pytest.fixture(scope="module")
def replay() -> Iterator[str]:
    with staged_console(StagedRun(timeline=TIMELINE)) as address:
        yield address


def settled(page: BrowserPage) -> list[str]:
    """Return what is cut off once the page has had time to settle."""
    until_s = time.monotonic() + PATIENCE_S
    while (faults := overflow(page.page)) and time.monotonic() < until_s:
        page.page.wait_for_timeout(LOOK_MS)
    return faults


@pytest.mark.slow
@pytest.mark.parametrize("of", ["flight", "replay"])
@pytest.mark.soak
def test_nothing_is_cut_off_on_any_panel_at_any_size(
    of: str, request: pytest.FixtureRequest, opened: Callable[..., BrowserPage]
) -> None:
    page = opened(request.getfixturevalue(of), SCREENS[0])
    page.wait_for_text("running")
    found = {}
    for size in SCREENS:
        page.page.set_viewport_size(size)
        for tab in (*FORMS, *TABLES):
            page.select_tab(tab)
            page.open_folders()
            if faults := settled(page):
                found[f"{tab} at {size['width']} px"] = faults
        assert page.page.evaluate(IN_SIGHT)
    assert found == {}
    assert page.faults == []


@pytest.mark.slow
def test_an_emergency_shows_plots_at_once_and_all_figures_of_the_drones(
    opened: Callable[..., BrowserPage],
) -> None:
    with staged_console(StagedRun(state="emergency", drain_percent_s=DRAIN_PERCENT_S)) as address:
        page = opened(address, SCREENS[1])
        page.page.locator("td", has_text="min").first.wait_for()

        # plots have curves as soon as they are opened, and keep their width
        page.select_tab("Plots")
        page.page.wait_for_function(DRAWN_JS)
        widths, shown_s = page.page.evaluate(WIDTHS_JS), page.state()["t_s"]
        page.until(f"s.t_s > {shown_s + 2.0}")
        assert page.page.evaluate(WIDTHS_JS) == widths

        found = {}
        page.select_tab("Drones")
        for size in (LOW, *SCREENS[:2]):
            page.page.set_viewport_size(size)
            if faults := settled(page):
                found[f"{size['width']} × {size['height']}"] = faults
        assert found == {}


@pytest.mark.slow
@pytest.mark.soak
def test_a_click_unfolds_an_event_until_the_next_click(flight: str, opened: Callable[..., BrowserPage]) -> None:
    page = opened(flight, SCREENS[0])
    page.wait_for_text("running")
    page.select_tab("Events")
    text = page.page.locator(".zsim-event-text").first
    text.wait_for()
    assert page.page.evaluate(KINDS_CUT_JS) == 0
    assert not page.page.evaluate(UNFOLDED_JS)
    text.click()
    page.page.wait_for_function(UNFOLDED_JS)
    shown_s = page.state()["t_s"]
    page.until(f"s.t_s > {shown_s + 2.0}")  # its row has been rebuilt
    assert page.page.evaluate(UNFOLDED_JS)
    text.click()
    page.page.wait_for_function(f"() => !({UNFOLDED_JS})()")


@pytest.mark.slow
def test_a_phone_shows_the_scene_above_one_panel(flight: str, opened: Callable[..., BrowserPage]) -> None:
    page = opened(flight, SCREENS[-1])
    page.wait_for_text("running")
    page.wait_for_notice()
    assert settled(page) == []
    page.page.wait_for_function(f"({COVERED_JS})().height < innerHeight * 0.6")
    scene = page.page.evaluate(COVERED_JS)
    assert scene["width"] == SCREENS[-1]["width"]
    assert scene["height"] > SCREENS[-1]["height"] / 3
    sheet = page.page.locator(".zsim-sheet").bounding_box()
    assert sheet["width"] == SCREENS[-1]["width"]
    page.close_notice()
    page.page.wait_for_function(f"({COVERED_JS})().free > 0.7")  # apart from the tools over the scene
    page.select_tab("Drones")
    page.page.get_by_role("tab", name="Fly", exact=True).wait_for(state="hidden")  # one panel at a time


@pytest.mark.slow
@pytest.mark.soak
def test_a_plot_keeps_its_size_when_the_cursor_enters_it(flight: str, opened: Callable[..., BrowserPage]) -> None:
    page = opened(flight, SCREENS[1])
    page.wait_for_text("running")
    page.select_tab("Plots")
    page.page.wait_for_function(DRAWN_JS)
    sizes = page.page.evaluate(SIZES_JS)
    page.page.locator(".uplot .u-over").first.hover()
    page.page.wait_for_function("() => !document.querySelector('.uplot .u-value').textContent.includes('-')")
    assert page.page.evaluate(SIZES_JS) == sizes


@pytest.mark.slow
@pytest.mark.soak
def test_plots_of_a_finished_run_can_show_any_variable(opened: Callable[..., BrowserPage]) -> None:
    run = StagedRun()
    with staged_console(run) as address:
        run.end()
        page = opened(address, SCREENS[1])
        page.wait_for_text("run over")
        page.select_tab("Plots")
        page.page.wait_for_function(DRAWN_JS)
        page.page.get_by_label("variables").click()
        page.page.get_by_role("option", name="drone1: x, y, z").click()
        page.page.get_by_text("x of drone1 [m]").wait_for()
        page.page.wait_for_function(DRAWN_JS)


@pytest.mark.slow
@pytest.mark.soak
def test_the_dark_theme_applies_to_all_of_one_page_only(flight: str, opened: Callable[..., BrowserPage]) -> None:
    page, other = opened(flight, SCREENS[1], drawn=True), opened(flight, SCREENS[1], drawn=True)
    for each in (page, other):
        each.wait_for_text("running")
        each.select_tab("Run")
    page.page.get_by_label("Dark theme").check()
    shown = f"({LIGHTNESS_JS})(parts)"
    dark = f"parts => {shown}.length === parts.length && {shown}.every(([behind, text]) => behind < 0.3 && text > 0.4)"
    light = f"parts => {shown}.length === parts.length && {shown}.every(([behind, text]) => behind > 0.7 && text < 0.6)"
    # Awaited, because the change rebuilds elements; the head is dark in both themes while no data arrive.
    page.page.wait_for_function(dark, arg=LIT)
    other.page.wait_for_function(light, arg=LIT)
    page.until_ground(lambda lightness, _: lightness < 0.35)
    other.until_ground(lambda lightness, _: lightness > 0.65)


@pytest.mark.slow
@pytest.mark.soak
def test_the_grid_is_visible_from_any_height(flight: str, opened: Callable[..., BrowserPage]) -> None:
    page = opened(flight, SCREENS[1], drawn=True)
    page.wait_for_text("running")
    page.press("Side")
    page.until_ground(lambda _, contrast: contrast > GRID_CONTRAST)
    page.page.locator("canvas[data-engine]").hover(position={"x": 200, "y": 300})
    for _ in range(ZOOMS):
        page.page.mouse.wheel(0, ZOOM_PX)
        page.page.wait_for_timeout(DRAWN_MS)
        assert page.ground()[1] > GRID_CONTRAST


@pytest.mark.slow
@pytest.mark.soak
def test_a_replay_at_its_end_disables_play_and_step(opened: Callable[..., BrowserPage]) -> None:
    run = StagedRun(past_s=TIMELINE["to_s"], timeline=TIMELINE)
    with staged_console(run) as address:
        run.stands, run.clock_state = True, "paused"
        page = opened(address, SCREENS[1])
        bar = page.page.locator("#zsim-record")
        for control in (bar.get_by_text("Play"), bar.get_by_text("Step")):
            control.and_(page.page.locator(":disabled")).wait_for()
            assert "end" in str(control.get_attribute("title"))
        assert bar.locator("input").is_enabled()
        page.select_tab("Run")
        page.page.get_by_role("button", name="Step", exact=True).and_(page.page.locator(":disabled")).first.wait_for()
