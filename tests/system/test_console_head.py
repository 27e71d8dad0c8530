"""The head of the console's page, in a real browser, with the console's answers supplied by the test."""

import functools
import importlib.resources
import itertools
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import needs_browser
from console_browser import HOLD_MS, IN_SIGHT, PATIENCE_MS, POLL_MS, SCREENS
from page_overflow import overflow
from wire import PATIENCE_S

from zsim_bridges.console.page_server import RunFiles

pytestmark = needs_browser

SIZE = {"width": 1280, "height": 200}
ADDRESS = "http://console.test/"  # of no machine: the test answers all requests
LOOKED_AT = f"{ADDRESS}head"
AUDIO_JS = """
window.tones = 0;
window.AudioContext = class {
  state = "running"; currentTime = 0; destination = null;
  resume() {}
  createOscillator() { return { frequency: {}, connect() {}, start() { window.tones += 1; }, stop() {} }; }
};"""
"""Replaces the browser's AudioContext and counts the tones that a page starts."""
LOOKS = 2  # polls of the console by the page: the second follows once the answer to the first is shown
RED = {"severity": "red", "subject": "drone1", "name": "battery", "text": "8 %", "for_s": 0.0, "acknowledged": False}


class Head:
    """A page with only the head.

    Attributes:
        page: the Playwright page.
        state: the console's answer to a poll.
        looks: number of polls by the page.
        copied: whether, at its last poll, the page had copied all that it keeps of an ending console.
    """

    def __init__(self, page: Any) -> None:
        self.page = page
        self.looks = 0
        self.copied = False
        self.commands: list[dict[str, Any]] = []
        refusals = {"land": "", "emergency": ""}
        self.state: dict[str, Any] = {
            "level": "running", "title": "running 7.0 s", "detail": "step", "t_s": 7.0, "age_s": 0.0,
            "refusals": refusals, "alarms": [],
        }  # fmt: skip
        frame = importlib.resources.files("zsim_bridges.console.frame")
        html = "".join(frame.joinpath(f"{part}.html").read_text("utf-8") for part in ("layout", "orders", "head_bar"))
        page.route(f"{ADDRESS}**", lambda route: route.fulfill(body=html, content_type="text/html"))
        page.route(LOOKED_AT, self._answer)
        page.route(f"{ADDRESS}command", self._command)
        page.goto(ADDRESS)

    def _answer(self, route: Any) -> None:
        self.looks += 1
        self.copied = "x-zsim-copied" in route.request.headers
        route.fulfill(body=json.dumps(self.state), content_type="application/json")

    def _command(self, route: Any) -> None:
        self.commands.append(route.request.post_data_json)
        route.fulfill(body="{}", content_type="application/json")

    def show(self, **state: Any) -> None:
        """Change the state, and wait until the page shows it."""
        self.state = {**self.state, **state}
        until, until_s = self.looks + LOOKS, time.monotonic() + PATIENCE_S
        while self.looks < until:
            assert time.monotonic() < until_s, (self.looks, until)
            self.page.wait_for_timeout(POLL_MS)

    def wait_for_copies(self) -> None:
        """Wait until the page has copied all that it keeps of an ending console."""
        until_s = time.monotonic() + PATIENCE_S
        while not self.copied:
            assert time.monotonic() < until_s
            self.page.wait_for_timeout(POLL_MS)

    def wait_until_laid_out(self, size: dict[str, int], holds: Callable[[], bool] = lambda: True) -> None:
        """Resize the page, and wait until both buttons are in sight, nothing is cut off and a condition holds."""
        self.page.set_viewport_size(size)
        self.page.wait_for_function(IN_SIGHT)
        until_s = time.monotonic() + PATIENCE_S
        while (cut := overflow(self.page)) or not holds():
            assert time.monotonic() < until_s, (size, cut)
            self.page.wait_for_timeout(POLL_MS)

    def wait_for(self, count: int, of: list[Any]) -> None:
        """Wait until a list has received `count` items from the page."""
        until_s = time.monotonic() + PATIENCE_S
        while len(of) < count:
            assert time.monotonic() < until_s, of
            self.page.wait_for_timeout(POLL_MS)

    def tones(self) -> int:
        """Return the number of tones that the page has started."""
        return self.page.evaluate("window.tones")


@pytest.fixture(scope="module")
def page(browser: Any) -> Iterator[Any]:
    context = browser.new_context()
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.add_init_script(AUDIO_JS)
    yield page
    context.close()


@pytest.fixture
def head(page: Any) -> Iterator[Head]:
    """The page, freshly loaded."""
    page.set_viewport_size(SIZE)
    yield Head(page)
    page.unroute_all(behavior="wait")
    page.goto("about:blank")


def test_a_red_alarm_sounds_once(head: Head) -> None:
    head.show()
    assert head.tones() == 0
    head.show(alarms=[{**RED, "severity": "amber"}])
    assert head.tones() == 0
    head.show(alarms=[RED])
    assert head.tones() == 1
    head.show(alarms=[RED, {**RED, "subject": "drone2"}])
    assert head.tones() == 2
    head.show(alarms=[])
    head.show(alarms=[RED])
    assert head.tones() == 3


def test_acknowledged_or_muted_alarms_do_not_sound(head: Head) -> None:
    head.show(alarms=[{**RED, "acknowledged": True}])
    assert head.tones() == 0
    sound = head.page.locator(".sound")
    sound.click()
    assert sound.get_attribute("aria-pressed") == "false"
    head.show(alarms=[RED])
    assert head.tones() == 0
    sound.click()
    head.show(alarms=[{**RED, "subject": "drone3"}])
    assert head.tones() == 1


def test_alarms_neither_hide_the_buttons_nor_are_cut_off(head: Head) -> None:
    detail = "step · waiting for estimator.drone1 on lab-computer-2 (40 s), estimator.drone2 on lab-computer-2 (40 s)"
    for size in SCREENS:
        for count, acknowledged in itertools.product((1, 2, 7), (False, True)):
            dead = {**RED, "name": "dead", "acknowledged": acknowledged}
            head.show(detail=detail, alarms=[{**dead, "subject": f"estimator.drone{i}"} for i in range(count)])
            head.wait_until_laid_out(size)


def test_an_alarm_is_acknowledged_by_its_button(head: Head) -> None:
    head.show(alarms=[RED])
    head.page.locator(".acknowledge").click()
    head.wait_for(1, head.commands)
    assert head.commands == [{"op": "acknowledge"}]


def ended(folder: Path, **state: Any) -> dict[str, Any]:
    """Return the head's state after a run, with the files of the run's folder."""
    over = {"level": "ended", "title": "run over at 330.0 s", "detail": "step · the duration is over"}
    return {**over, **RunFiles(folder).state(page="", has_copies=False), **state}


def gone(head: Head) -> None:
    """Let the console end."""
    head.page.unroute(LOOKED_AT)
    head.page.route(LOOKED_AT, lambda route: route.abort())


@pytest.mark.parametrize("above", ["name", "name-that-no-line-can-hold" * 8])
def test_report_and_record_of_a_finished_run_are_shown(head: Head, above: str) -> None:
    state = ended(Path(f"/home/somebody/lab/flights/with/a/long/{above}/runs/step-20261125-065514"))
    files = state["files"]
    head.show(files=files)
    shown = head.page.locator(".files")
    assert shown.text_content() == ""
    head.show(**state)
    for size in SCREENS:
        head.wait_until_laid_out(size, lambda: are_named(files, head))
    head.show(files={name: {**each, "size_bytes": 7} for name, each in files.items()})
    assert [link.get_attribute("href") for link in shown.locator("a").all()] == ["/report", "/record"]
    for size in SCREENS:
        head.page.set_viewport_size(size)
        for link in shown.locator("a").all():
            link.click(trial=True)  # nothing covers the middle of its box
    gone(head)
    head.page.locator("[data-level=gone]").wait_for()
    for size in SCREENS:
        head.wait_until_laid_out(size, lambda: are_named(files, head))
    assert shown.locator("a").count() == 0


def test_a_page_keeps_report_and_record_of_an_ending_console(head: Head, tmp_path: Path) -> None:
    content = {"report": "<title>the report</title>", "record": "MCAP"}
    (tmp_path / "report.html").write_text(content["report"])
    (tmp_path / "run.mcap").write_text(content["record"])
    for name, text in content.items():
        head.page.route(f"{ADDRESS}{name}", functools.partial(serve, text))
    head.show(**ended(tmp_path, leaves=True))
    head.wait_for_copies()
    gone(head)
    head.page.get_by_text("the console has ended with its run").wait_for()
    links = head.page.locator(".files a")
    with head.page.context.expect_page() as report:
        links.nth(0).click()
    report.value.wait_for_load_state()
    assert report.value.title() == "the report"
    with head.page.expect_download() as record:
        links.nth(1).click()
    assert (record.value.suggested_filename, record.value.path().read_text()) == ("run.mcap", content["record"])


def test_a_page_does_not_copy_a_record_of_a_terabyte(head: Head, tmp_path: Path) -> None:
    state = ended(tmp_path, leaves=True)
    head.show(**{**state, "files": {"record": {"path": "/runs/large/run.mcap", "size_bytes": 10**12}}})
    head.wait_for_copies()
    gone(head)
    head.page.get_by_text("the console has ended with its run").wait_for()
    assert head.page.locator(".files").text_content() == "record: /runs/large/run.mcap"
    assert head.page.locator(".files a").count() == 0


def test_the_path_of_a_file_that_cannot_be_copied_is_shown(head: Head, tmp_path: Path) -> None:
    for name in ("report.html", "run.mcap"):
        (tmp_path / name).write_text(name)
    head.page.route(f"{ADDRESS}report", lambda route: route.abort())
    head.page.route(f"{ADDRESS}record", functools.partial(serve, "MCAP"))
    head.show(**ended(tmp_path, leaves=True))
    head.wait_for_copies()
    gone(head)
    head.page.get_by_text("the console has ended with its run").wait_for()
    assert head.page.locator(".files a").all_text_contents() == [str(tmp_path / "run.mcap")]
    assert str(tmp_path / "report.html") in str(head.page.locator(".files").text_content())


def test_a_missing_report_is_not_shown_when_the_console_ends(head: Head, tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("MCAP")
    head.page.route(f"{ADDRESS}record", functools.partial(serve, "MCAP"))
    head.show(**ended(tmp_path))
    assert "report.html" in str(head.page.locator(".files").text_content())
    head.show(leaves=True)
    head.wait_for_copies()
    assert head.page.locator(".files").text_content() == f"record: {tmp_path / 'run.mcap'}"


def test_the_next_run_on_the_same_port_shows_no_old_copies(head: Head, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("")
    head.page.route(f"{ADDRESS}report", functools.partial(serve, ""))
    head.show(**ended(tmp_path, leaves=True))
    head.wait_for_copies()
    head.page.locator('.files a[href^="blob:"]').wait_for()
    head.show(level="running", leaves=False)
    assert not head.copied
    head.show(level="ended")
    assert head.page.locator(".files a").get_attribute("href") == "/report"


STALL_MS = 3500  # stall of the page, longer than the age at which data count as lost
STALL_JS = "ms => { const until = performance.now() + ms; while (performance.now() < until); }"


class OrderDesk:
    """The console's answers to the orders of a page.

    Attributes:
        orders: orders received, with repetitions.
        state: state answered for every order; empty for no answer.
    """

    def __init__(self, head: Head) -> None:
        self.orders: list[dict[str, Any]] = []
        self.state = ""
        head.page.unroute(f"{ADDRESS}command")
        head.page.route(f"{ADDRESS}command", self._take)

    def _take(self, route: Any) -> None:
        order = route.request.post_data_json
        self.orders.append(order)
        if not self.state:
            route.abort()
            return
        row = {
            **order,
            "subject": "",
            "state": self.state,
            "reason": "drone1: not now",
            "waiting": ["drone2"],
            "t_s": 41.2,
        }
        route.fulfill(body=json.dumps({"order": row}), content_type="application/json")


def row(head: Head, state: str, *terms: str) -> None:
    """Wait for the row of an order that is in a state and contains terms."""
    found = head.page.locator(f"#zsim-orders [data-state={state}]")
    for term in terms:
        found = found.filter(has_text=term)
    found.wait_for()


def test_an_emergency_is_repeated_until_the_world_confirms_it(head: Head) -> None:
    desk = OrderDesk(head)
    head.show(run_id="r7")
    gone(head)
    head.page.locator("[data-level=gone]").wait_for()
    button = head.page.locator(".emergency")
    assert button.is_enabled()
    assert head.page.locator(".land").is_enabled()
    button.hover()
    head.page.mouse.down()
    row(head, "sent", "EMERGENCY all", "not confirmed", "the console does not answer")
    head.page.mouse.up()
    head.wait_for(LOOKS, desk.orders)
    desk.state = "sent"
    row(head, "sent", "EMERGENCY all", "not confirmed", "drone1: not now")
    for size in SCREENS:
        head.wait_until_laid_out(size)
    desk.state = "confirmed"
    row(head, "confirmed", "EMERGENCY all", "confirmed at 41.2 s")
    sent = len(desk.orders)
    assert {(order["op"], order["run"]) for order in desk.orders} == {("emergency", "r7")}
    assert len({order["id"] for order in desk.orders}) == 1
    head.page.wait_for_timeout(LOOKS * HOLD_MS)
    assert len(desk.orders) == sent


def test_a_refused_order_is_shown_until_it_is_clicked(head: Head) -> None:
    desk = OrderDesk(head)
    desk.state = "refused"
    head.page.locator(".land").click()
    row(head, "refused", "Land all", "REFUSED", "not now")
    head.page.locator("#zsim-orders [data-state=refused]").click()
    head.page.locator("#zsim-orders [data-state=refused]").wait_for(state="detached")


@pytest.mark.parametrize("key", ["Enter", "Space"])
def test_an_emergency_needs_a_long_press_on_the_keyboard_too(head: Head, key: str) -> None:
    desk = OrderDesk(head)
    desk.state = "confirmed"
    head.page.locator(".emergency").focus()
    head.page.keyboard.press(key)
    head.page.locator("#zsim-notes").get_by_text("hold it").wait_for()
    head.page.locator(".emergency").click()
    assert desk.orders == []
    head.page.keyboard.down(key)
    row(head, "confirmed", "EMERGENCY all")
    head.page.keyboard.up(key)
    assert len(desk.orders) == 1


def test_orders_need_no_websocket(browser: Any) -> None:
    with browser.new_context() as context:
        head = Head(context.new_page())
        desk = OrderDesk(head)
        desk.state = "confirmed"
        head.page.add_init_script("window.WebSocket = class { constructor() { throw new Error('forbidden'); } };")
        head.page.reload()
        head.page.locator(".land").click()
        row(head, "confirmed", "Land all")


def test_the_websocket_reopens_despite_an_error_and_sends_queued_messages(head: Head) -> None:
    sockets: list[Any] = []
    sent: list[Any] = []

    def serve(opened: Any) -> None:
        sockets.append(opened)
        opened.on_message(
            lambda text: sent.append(text)
        )  # a lambda, because playwright sets attributes of its handlers

    head.page.route_web_socket("ws://console.test/actions", serve)
    head.page.reload()
    head.wait_for(1, sockets)
    head.page.evaluate("""zsimPage.on("close", () => {
        zsimPage.send({ do: "go" });
        zsimPage.send({ do: "choose" }, true);
        throw new Error("a fault of a part");
    })""")
    sockets[0].close()
    head.wait_for(2, sockets)
    head.page.evaluate("zsimPage.send({ do: 'look' }, true)")
    head.wait_for(2, sent)
    assert [json.loads(each)["do"] for each in sent] == ["choose", "look"]


def test_a_stalled_page_reports_itself_and_not_the_console(head: Head) -> None:
    head.show()
    head.page.evaluate(STALL_JS, STALL_MS)
    head.page.locator("#zsim-notes").get_by_text("this page stood still").wait_for()
    assert head.page.locator("#zsim-head").get_attribute("data-level") == "running"
    assert head.page.locator(".emergency").is_enabled()


def test_stale_data_are_marked_old_and_then_lost(head: Head) -> None:
    head.show()
    head.show(heard_s=1.5)
    head.page.locator(
        "body[data-zsim-age=old]"
    ).wait_for()  # awaited, because a brief stall of the page adds to the age
    head.show(heard_s=0.1)
    head.page.locator("body[data-zsim-age='']").wait_for()
    gone(head)
    head.page.locator("body[data-zsim-age=old]").wait_for()
    head.page.locator("body[data-zsim-age=lost]").wait_for()


def serve(text: str, route: Any) -> None:
    route.fulfill(body=text, content_type="text/html")


def are_named(files: dict[str, Any], head: Head) -> bool:
    shown = str(head.page.locator(".files").text_content())
    return all(each["path"] in shown for each in files.values())
