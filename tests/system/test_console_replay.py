"""A replay in a browser: it is recognisable as a replay, and shows the record around the instant on the timeline."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from chromium import needs_browser
from console_browser import SCREENS, BrowserPage
from page_overflow import FAULTS_JS
from staged_console import StagedRun, staged_console

pytestmark = needs_browser

TIMELINE = {"from_s": 0.0, "to_s": 400.0, "marks": [{"t_s": 20.0, "kind": "emergency", "text": "rotors stopped"}]}
AT_S = 300.0  # position of the replay when the page is opened
BACK_S = 80.0
HEAD_JS = "() => getComputedStyle(document.getElementById('zsim-head')).backgroundColor.match(/[0-9]+/g).map(Number)"
TINT_JS = "() => getComputedStyle(document.body, '::after').backgroundColor"
CURVE_JS = """() => [...document.querySelectorAll(".uplot canvas")].map(canvas => {
  if (!canvas.width) return null;
  const { width, height } = canvas, points = canvas.getContext("2d").getImageData(0, 0, width, height).data;
  const near = (i, colour) => points[i + 3] > 128 && colour.every((value, k) => Math.abs(points[i + k] - value) < 24);
  return [[232, 89, 12], [112, 72, 232]].map(colour => {
    const columns = [];
    for (let x = 0; x < width; x++) for (let y = 0; y < height; y++)
      if (near(4 * (y * width + x), colour)) { columns.push(x / width); break; }
    return columns;
  });
})"""
"""Returns, for each plot, the columns (0 to 1) with the true curve, and those with the line at the shown instant."""
FILLED_JS = f"""() => {{ const found = ({CURVE_JS})();
  return found.length === 3 && found.every(each => each && each[1].length && each[1].length < 12
    && each[0].some(x => x < each[1][0] - .2) && each[0].some(x => x > each[1][0] + .2)); }}"""
"""Returns whether each plot has its curve on both sides of the shown instant."""
RED = (201, 42, 42)


@pytest.fixture(scope="module")
def replay() -> Iterator[tuple[StagedRun, str]]:
    run = StagedRun(past_s=1.0, timeline=TIMELINE, state="emergency")
    with staged_console(run) as address:
        run.stands, run.clock_state, run.t_s = True, "paused", AT_S
        run.publish_views()
        yield run, address


def test_a_replay_is_recognisable_and_shows_the_record_around_its_cursor(
    replay: tuple[StagedRun, str], opened: Callable[..., BrowserPage]
) -> None:
    run, address = replay
    page = opened(address, SCREENS[1])
    head: Any = page.page.locator("#zsim-head")

    # all drones are in an emergency, but nobody has to act: no red, no sound; the progress is that of the record
    title = f"REPLAY · paused {AT_S:.1f} of {TIMELINE['to_s']:.1f} s (75 %)"
    head.locator(".title").get_by_text(title, exact=True).wait_for()
    red, green, blue = page.page.evaluate(HEAD_JS)
    assert (red, green, blue) != RED
    assert blue > red > green
    assert page.page.evaluate(TINT_JS) not in ("rgba(0, 0, 0, 0)", "transparent")
    assert head.locator(".acknowledge").is_hidden()
    page.page.wait_for_function(f"() => ({FAULTS_JS})().length === 0")

    # curves on both sides of the instant, before anything was played
    page.select_tab("Plots")
    page.page.wait_for_function(FILLED_JS)
    (first, *_) = page.page.evaluate(CURVE_JS)

    # the same after a jump back, and trails on the map
    run.t_s = BACK_S
    run.publish_views()
    page.wait_for_text(f"{BACK_S:.1f} of {TIMELINE['to_s']:.1f} s (20 %)")
    page.page.wait_for_function(f"line => ({FILLED_JS})() && ({CURVE_JS})()[0][1][0] !== line", arg=first[1][0])
    page.page.locator("#zsim-flight .map").click()
    trails = "() => JSON.parse(document.getElementById('zsim-map').dataset.trails ?? '[]')"
    page.page.wait_for_function(f"() => {{ const found = ({trails})();"
        f" return found.length === 3 && found.every(each => each.points > 30 && each.from_s < {BACK_S - 50}"
        f" && each.to_s <= {BACK_S}); }}")  # fmt: skip
    assert page.faults == []
