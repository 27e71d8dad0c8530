"""Several operators at one console, and its alarms, pre-flight check and faults, in real browsers."""

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from chromium import needs_browser
from console_browser import PATIENCE_MS, VIEWPORT, BrowserPage
from page_overflow import overflow
from staged_console import StagedRun, staged_console

from zsim.contract import keys
from zsim.contract.run_messages import ClusterRequest
from zsim_bridges.console import control_desk

pytestmark = [
    needs_browser,
    pytest.mark.slow,
    pytest.mark.soak,
]

SCREENS = ({"width": 1440, "height": 900}, {"width": 1024, "height": 768}, {"width": 390, "height": 844})
OPACITY_JS = "button => getComputedStyle(button).opacity"
PAST_S = 5.0


@pytest.fixture
def run() -> StagedRun:
    return StagedRun(PAST_S)


@pytest.fixture
def address(run: StagedRun, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(control_desk, "LOST_S", math.inf)  # pages without a graphics card may stall for long
    with staged_console(run) as address:
        yield address


def see(page: BrowserPage, text: str | re.Pattern[str]) -> Any:
    """Wait until the page shows a text, and return its locator."""
    found = page.page.get_by_text(text).first
    found.wait_for(timeout=PATIENCE_MS)
    return found


def button(page: BrowserPage, name: str) -> Any:
    return page.page.get_by_role("button", name=name, exact=True)


def requests(run: StagedRun, op: str) -> list[dict[str, Any]]:
    return [args for asked, args in run.link.asked if asked == op]


def wait_until(page: BrowserPage, holds: Callable[[], bool]) -> None:
    for _ in range(100):
        if holds():
            return
        page.page.wait_for_timeout(PATIENCE_MS / 100)
    raise AssertionError("it never came true")


def type_into(page: BrowserPage, place: int, value: str) -> None:
    """Type into the number field beside the slider of a variable."""
    field = page.page.locator("input[inputmode=decimal]").nth(place)
    field.fill(value)
    field.press("Enter")


def test_control_stays_with_one_operator_until_given_or_released(
    run: StagedRun, address: str, opened: Callable[..., BrowserPage]
) -> None:
    first = opened(address)
    see(first, "alone here")
    second = opened(address)
    for page, other in ((first, "operator 2"), (second, "operator 1")):
        page.close_notice()
        see(page, f"also here: {other}")

    # moving a control takes control; the other operator's input is refused and reset to the previous value
    type_into(first, X_C, "7")
    see(second, "operator 1")
    button(second, "Ask for main").wait_for()
    wait_until(first, lambda: len(requests(run, "target")) == 1)
    type_into(second, X_C, "-30")
    see(second, "Refused: operator 1 is in control of main")
    wait_until(second, lambda: second.page.locator("input[inputmode=decimal]").nth(X_C).input_value() != "-30")
    assert [args["values"] for args in requests(run, "target")] == [{"x_c": 7.0}]
    engage = second.page.get_by_role("slider").first
    wait_until(second, lambda: float(engage.locator("xpath=ancestor-or-self::*[@id][1]").evaluate(OPACITY_JS)) < 0.5)

    # every operator may hold and land
    button(second, "Hold").click()
    wait_until(second, lambda: requests(run, "hold") == [{}])

    # one request for control is declined, the next one granted
    button(second, "Ask for main").click()
    see(first, "operator 2 asks for it")
    first.page.set_viewport_size(SCREENS[-1])
    button(first, "Keep main").wait_for()
    wait_until(first, lambda: overflow(first.page) == [])
    first.page.set_viewport_size(VIEWPORT)
    button(first, "Keep main").click()
    see(second, "operator 1 keeps control of main")
    button(second, "Ask for main").click()
    button(first, "Give main to operator 2").click()
    see(second, "operator 1 gives you control of main")
    type_into(second, X_C, "3")
    wait_until(second, lambda: len(requests(run, "target")) == 2)
    assert requests(run, "target")[-1]["values"] == {"x_c": 3.0}

    # a closed page releases control to the operator who requested it
    button(first, "Ask for main").click()
    second.page.close()
    see(first, re.compile("operator 2 has left"))
    see(first, "alone here")
    type_into(first, X_C, "8")
    wait_until(first, lambda: len(requests(run, "target")) == 3)

    # requests by another console are shown
    values = {"x_c": -4.0}
    request = ClusterRequest(round(run.t_s * 1e9), 0, "target", {"values": values}, "console.2", True)
    run.link.publish(keys.cluster_request("main"), request)
    see(first, re.compile(r"main: target by console\.2.*x_c=-4"))
    assert first.faults == []


X_C = 1  # index of x_c's number field on the page; that of `over [s]` precedes it


def test_alarms_stay_until_acknowledged_and_failsafes_name_their_cause(
    run: StagedRun, address: str, opened: Callable[..., BrowserPage]
) -> None:
    page = opened(address)
    page.close_notice()
    head = page.page.locator("#zsim-head")

    # a drone flown by hand in an engaged formation
    run.changes = {
        name: {"commander": "console.run" if name == "drone2" else "controller.main"}
        for name in ("drone1", "drone2", "drone3")
    }
    head.get_by_text("main: other commanders").wait_for()
    head.get_by_text("engaged – drone2 is flown by console.run").wait_for()

    # a process dies and is restarted
    run.happen(
        "death", "estimator.drone1", "estimator.drone1 on lab (pid 7) died; on_death: restart", host="lab", pid=7
    )
    head.get_by_text("estimator.drone1: dead", exact=True).wait_for()
    run.happen("restart", "estimator.drone1", "estimator.drone1 on lab (pid 8)", host="lab", pid=8)
    head.get_by_text("estimator.drone1: dead (over)").wait_for()
    button(page, "Acknowledge").click()
    head.get_by_text("estimator.drone1: dead").wait_for(state="detached")

    # a dropped process counts as dead too
    run.happen("death", "detector.main", "detector.main on lab (pid 9) died; on_death: drop", host="lab", pid=9)
    run.happen("drop", "detector.main", "detector.main is waited for no longer")
    head.get_by_text("detector.main: dead", exact=True).wait_for()

    # an empty battery: the cause is shown wherever the drone's state is, and take-off is disabled afterwards
    cause = "drone3 lands by itself: it has 2.0 % of charge"
    run.changes["drone3"] = {"state": "landing", "battery_percent": 2.0}
    run.happen("landing", "drone3", cause, cause="battery", charge_percent=2.0)
    head.get_by_text("drone3: lands by itself").wait_for()
    head.get_by_text(cause).wait_for()
    page.page.locator("td", has_text=cause).wait_for()
    run.phase = "idle"
    upside_down = (0.0, 1.0, 0.0, 0.0)
    run.changes = {
        "drone1": {"state": "landed"},
        "drone2": {"state": "landed", "orientation_wxyz": upside_down},
        "drone3": {"state": "landed", "battery_percent": 2.0},
    }
    head.get_by_text("drone2: upside down").or_(head.get_by_text(re.compile(r"\+ \d"))).first.wait_for()
    takeoff = page.page.get_by_role("button", name="Take off", exact=True)
    takeoff.and_(page.page.locator(":disabled")).wait_for()
    for told in (
        "✗ drone2: upright tilted by 180°; must be 30° or less",
        "✗ drone3: battery 2 %; must be 10 % or more",
    ):
        see(page, told)
    see(page, "✓ ready: drone1")
    assert page.page.get_by_text("nobody is on the ground").count() == 0
    for size in SCREENS:
        page.page.set_viewport_size(size)
        wait_until(page, lambda: overflow(page.page) == [])
    page.page.set_viewport_size(VIEWPORT)

    # all drones are fit: take-off is offered and sent
    run.changes = {f"drone{k}": {"state": "landed"} for k in (1, 2, 3)}
    takeoff.and_(page.page.locator(":enabled")).click()
    wait_until(page, lambda: requests(run, "takeoff") == [{}])

    # a fault without its magnitude is refused; the typed syntax is that of the terminal
    page.select_tab("Faults")
    page.open_folders()
    see(page, "30 % of the messages between the processes world and estimator.drone1; not by radio")
    parameters = page.page.get_by_role("textbox").last
    parameters.fill("")
    parameters.press("Enter")
    button(page, "Inject it").click()
    see(page, re.compile("is missing; must be"))
    assert requests(run, "fault_add") == []
    parameters.fill("probability=0.5 --for 5s --at 2min")
    parameters.press("Enter")
    button(page, "Inject it").click()
    wait_until(page, lambda: len(requests(run, "fault_add")) == 1)
    sent = requests(run, "fault_add")[0]
    assert {"probability": 0.5, "for_s": 5.0, "at_s": 120.0}.items() <= sent.items()
    assert page.faults == []
