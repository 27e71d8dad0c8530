"""The operator's console, in a real browser and on a running federation."""

import io
import json
import re
import signal
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from urllib.parse import urlsplit

import msgspec
import pytest
import zstandard
from chromium import needs_browser
from console_browser import IN_SIGHT, PATIENCE_MS, POLL_MS, SCREENS, VIEWPORT, BrowserPage, console
from federation import Federation, Role, free_port
from refused import has_terms
from staged_console import StagedRun, staged_console
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from wire import PATIENCE_S

from zsim_bridges.console.page_server import ViewerCamera

STRIP = {"width": 860, "height": 120}  # viewport of a page whose rendering is not checked
STEER = "a-good-token"
LOOK_S = 0.5  # interval at which a page polls its console
TRIAD = """
name: triad
seed: 3
duration_s: 3600
sensors: {preset: paper, gps: {position_m: {noise: 0.2}}}
drones:
  - {name: drone1, position_m: [0.0, 1.5, 0.0], yaw_deg: 90}
  - {name: drone2, position_m: [-1.5, -1.5, 0.0], yaw_deg: 90}
  - {name: drone3, position_m: [1.5, -1.5, 0.0], yaw_deg: 90}
clusters:
  - {name: main, drones: [drone1, drone2, drone3]}
"""
PLACE_OF_P = 9  # index among the sliders: x_c, y_c, z_c, roll, pitch, yaw, three headings, p
CAMERA = ViewerCamera(  # a page's first message; viser ignores the page's controls until then
    (1.0, 0.0, 0.0, 0.0), (0.0, -5.0, 3.0), 1.0, 0.01, 1000.0, 600, 800, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
)


def status(address: str, **headers: str) -> int:
    """Return the HTTP status of a GET."""
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=PATIENCE_S) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        error.close()
        return error.code


def command(address: str, op: str) -> int:
    """Return the HTTP status of a command, as sent by a button in the page's head."""
    request = urllib.request.Request(address, json.dumps({"op": op}).encode())
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        error.close()
        return error.code


def colours(picture: bytes) -> int:
    """Return the number of colours in a picture scaled to 160 × 90 pixels."""
    image = pytest.importorskip("PIL.Image")
    return len(image.open(io.BytesIO(picture)).convert("RGB").resize((160, 90)).getcolors(160 * 90))


class PageConnection:
    """A page without rendering: it exchanges the messages of viser's own page over the same websocket.

    Attributes:
        ids: ids of the page's controls, by label.
    """

    def __init__(self, address: str) -> None:
        viser = pytest.importorskip("viser", reason="viser is not installed; pip install '.[console]'")
        subprotocols: Any = [f"viser-v{viser.__version__}"]
        where = f"ws://{urlsplit(address).netloc}{urlsplit(address).path}"
        self._socket = connect(where, subprotocols=subprotocols, compression=None, max_size=None)
        self._socket.send(msgspec.msgpack.encode(CAMERA))
        self._batches: SimpleQueue[list[dict[str, Any]]] = SimpleQueue()
        self._messages: deque[dict[str, Any]] = deque()  # received but not yet examined
        self.ids: dict[str, str] = {}
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._socket.close()
        self._thread.join()

    def _read(self) -> None:
        """Read continuously, as a page does: unread messages would hold back later ones."""
        with suppress(ConnectionClosed):
            for packet in self._socket:
                assert isinstance(packet, bytes)
                size = int.from_bytes(packet[8:16], "little")
                plain = zstandard.ZstdDecompressor().decompress(packet[16 : 16 + size])
                self._batches.put(msgspec.msgpack.decode(plain, strict=False)["messages"])

    def put(self, label: str, value: Any) -> None:
        """Report a control as moved or pressed."""
        output = {"type": "GuiUpdateMessage", "uuid": self.ids[label], "updates": {"value": value}}
        self._socket.send(msgspec.msgpack.encode(output))

    def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the next message that meets a condition, and register new controls meanwhile."""
        until_s = time.monotonic() + PATIENCE_S
        while True:
            while self._messages:
                message = self._messages.popleft()
                if wanted(message):
                    return message
            self._take_in(until_s)

    def wait_for_control(self, label: str) -> None:
        """Wait until the page has a control."""
        until_s = time.monotonic() + PATIENCE_S
        while label not in self.ids:
            self._take_in(until_s)

    def _take_in(self, until_s: float) -> None:
        """Receive a batch of messages and register the controls in it."""
        batch = self._batches.get(timeout=max(0.0, until_s - time.monotonic()))
        for message in batch:
            label = (message.get("props") or {}).get("label")
            if label and "uuid" in message:
                self.ids[label] = message["uuid"]
        self._messages.extend(batch)


@pytest.fixture
def connected() -> Iterator[Callable[[str], PageConnection]]:
    """Return a function that opens an address as a page without rendering."""
    with ExitStack() as stack:

        def open_it(address: str) -> PageConnection:
            made = PageConnection(address)
            stack.callback(made.close)
            return made

        yield open_it


def shown(address: str, until: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """Return the state that a console shows, once it meets a condition."""
    until_s = time.monotonic() + PATIENCE_S
    while True:
        with urllib.request.urlopen(f"{address}state", timeout=PATIENCE_S) as answer:
            state = json.load(answer)
        if until(state):
            return state
        assert time.monotonic() < until_s, f"it never came so far: {state}"
        time.sleep(POLL_MS / 1000)


def press_until(address: str, page: PageConnection, label: str, wanted: str) -> None:
    """Press a button, greyed out at first, repeatedly until all three drones are in a state."""

    def press(state: dict[str, Any]) -> bool:
        page.put(label, True)
        return states(state) == [wanted] * 3

    shown(address, press)


def states(shown: dict[str, Any]) -> list[str]:
    return [drone["state"] for drone in shown.get("drones", ())]


@needs_browser
@pytest.mark.slow
@pytest.mark.soak
def test_an_operator_sees_three_drones_and_flies_them(
    federation: Federation, opened: Callable[..., BrowserPage]
) -> None:
    run = federation.run(TRIAD, "--rate", "4")  # a browser without a graphics card renders meanwhile
    _, links = console(federation, "--token", STEER)

    # a token is required
    bare = links["steer"].partition("?")[0]
    assert status(bare) == 401
    assert status(f"{bare}state") == 401
    assert status(f"{bare}?token=wrong") == 401
    refused = opened(bare, STRIP)
    refused.wait_for_text("needs the token")

    operator = opened(links["steer"], drawn=True)
    assert "token" not in operator.page.url
    viewer = opened(links["look"], STRIP)
    operator.wait_for_text("running")
    operator.close_notice()
    start = operator.until("s.drones.length == 3 && s.clusters.length == 1 && s.clock == 'running'")
    assert [drone["state"] for drone in start["drones"]] == ["landed"] * 3

    # a viewer sees the controls but cannot use them
    button = viewer.page.get_by_role("button", name="Take off", exact=True)
    button.wait_for(state="attached")
    button.evaluate("button => button.click()")
    later = operator.until(f"s.t_s > {start['t_s'] + 2}")
    assert later["clusters"][0]["phase"] == "idle"

    # a viewer has a camera of its own
    assert viewer.page.locator("#zsim-tools [aria-pressed=true]").text_content() == "Follow"
    viewer.page.locator("#zsim-tools").get_by_text("Follow").evaluate("button => button.click()")
    viewer.page.locator("#zsim-tools [aria-pressed=false]").wait_for(state="attached")
    operator.page.locator("#zsim-tools").get_by_text("Top").evaluate("button => button.click()")

    # a live run has no timeline
    assert not operator.page.locator("#zsim-record").is_visible()

    # a command that would be refused is greyed out
    engage = operator.page.get_by_role("button", name="Engage", exact=True)
    engage.and_(operator.page.locator(":disabled")).wait_for()

    # a button makes the drones take off
    operator.press("Take off")
    aloft = operator.until("s.drones.every(d => d.state == 'flying' && d.position_m[2] > 0.8)")
    for before, after in zip(start["drones"], aloft["drones"], strict=True):
        assert after["position_m"][2] - before["position_m"][2] > 0.7
    viewer.page.get_by_text("main: assembling").first.wait_for(state="attached")
    viewer.page.close()
    assert colours(operator.page.screenshot(timeout=PATIENCE_MS)) > 200
    operator.until("s.clusters[0].reason == 'ready to engage'")
    operator.press("Engage")
    engaged = operator.until("s.clusters[0].phase == 'engaged'")

    # a slider sets the desired p, and the true p follows
    slider = operator.page.get_by_role("slider").nth(PLACE_OF_P)
    engaged_p = engaged["clusters"][0]["desired"]["p"]
    operator.page.get_by_role("button", name="Hold", exact=True).and_(operator.page.locator(":enabled")).wait_for()
    slider.and_(operator.page.locator(f"[aria-valuenow='{engaged_p:.1f}']")).wait_for(timeout=PATIENCE_MS)
    slider.focus()
    for _ in range(12):
        slider.press("ArrowRight")
    wanted = float(str(slider.get_attribute("aria-valuenow")))
    assert wanted > engaged_p + 0.3  # a press between two updates of the page may be lost
    operator.until(f"Math.abs(s.clusters[0].desired.p - {wanted}) < 0.06")
    there = operator.until(f"Math.abs(s.clusters[0].true.p - {wanted}) < 0.3")

    # plots keep their width
    operator.select_tab("Plots")
    operator.page.locator(".uplot canvas").first.wait_for()
    width = "document.querySelector('.uplot-container').offsetWidth"
    width_px, now_s = operator.page.evaluate(width), operator.state()["t_s"]
    operator.until(f"s.t_s > {now_s + 20}")
    assert operator.page.evaluate(width) == width_px

    # a button injects a loss of GPS
    before = there["drones"][0]["sigma_m"]
    operator.select_tab("Faults")
    operator.press("GPS lost")
    operator.until("s.faults.some(f => f.kind == 'gps_dropout' && f.target == 'drone1')")
    grown = operator.until(f"s.drones[0].sigma_m > {1.5 * before}")
    assert grown["drones"][1]["sigma_m"] < 1.2 * before
    operator.select_tab("Events")
    operator.wait_for_text("gps_dropout of drone1 begins")
    operator.press("Clear all faults")
    operator.until("s.faults.length == 0")

    # both buttons of the head are in sight on every screen
    for size in SCREENS:
        operator.page.set_viewport_size(size)
        operator.page.wait_for_function(IN_SIGHT)
    operator.page.set_viewport_size(VIEWPORT)

    # a button makes the drones land
    operator.select_tab("Fly")
    operator.press("Land")
    operator.until("s.drones.every(d => d.state == 'landed')")

    # the page shows that the run is over
    assert operator.page.locator("body.zsim-old").count() == 0
    run.signal(signal.SIGINT)
    operator.page.locator("body.zsim-old").wait_for(state="attached")
    assert operator.page.locator("#zsim-age").is_visible()
    run.ends(with_code=130)
    for page in (operator, viewer, refused):
        assert page.outside() == set()
        assert page.faults == []


def test_operators_see_controls_that_others_move(
    federation: Federation, connected: Callable[[str], PageConnection]
) -> None:
    federation.world(TRIAD, "--rate", "1")
    role, links = console(federation)
    role.line("console.1: in run")
    label = "over [s]"
    one, other = connected(links["steer"]), connected(links["steer"])
    for page in (one, other):
        page.wait_for_control(label)
    one.put(label, 7.5)
    other.until(
        lambda message: (
            message["type"] == "GuiUpdateMessage"
            and message["uuid"] == one.ids[label]
            and message["updates"].get("value") == 7.5
        )
    )


@pytest.mark.soak
def test_an_emergency_stops_a_drone_that_another_operator_flies(
    federation: Federation, connected: Callable[[str], PageConnection]
) -> None:
    federation.run(TRIAD, "--rate", "4")
    role, links = console(federation)
    role.line("console.1: in run")
    address = links["steer"]
    page = connected(address)
    page.wait_for_control("Take off")
    shown(address, lambda state: states(state) == ["landed"] * 3)
    press_until(address, page, "Take off", "flying")
    assert federation.client().request("world/control", "acquire", drone="drone1", priority=10)["ok"]
    assert command(f"{links['look']}/command", "emergency") in (404, 405)  # the view-only link has no such path
    assert command(f"{address}command", "dance") == 400
    assert command(f"{address}command", "emergency") == 200
    shown(address, lambda state: states(state) == ["emergency"] * 3)
    page.wait_for_control("Reset all")
    press_until(address, page, "Reset all", "landed")


def test_a_run_prints_its_console_link_and_ends_all_its_processes(federation: Federation) -> None:
    run = federation.run(TRIAD, "--rate", "2", "--console")
    address = run.line("steer at").text.rpartition(" ")[2]
    assert status(address) == 200
    assert status(f"{address}view") == 200
    assert status(address, Host="evil.example") == 401
    assert status(address, Origin="http://evil.example") == 401
    run.line("× 2.0 real time")
    three = ["drone1", "drone2", "drone3"]
    shown(address, lambda state: [drone["name"] for drone in state.get("drones", ())] == three)
    run.signal(signal.SIGINT)
    run.ends(with_code=130)
    federation.nobody_left()


@needs_browser
def test_a_page_keeps_report_and_record_after_the_console_ends(federation: Federation, opened) -> None:
    where = "--out", str(federation.out), "--listen", federation.endpoint
    run = federation.start("run", federation.write(TRIAD), "--console", "--rate", "2", *where)
    page = opened(run.line("steer at").text.rpartition(" ")[2], STRIP).page
    page.locator("#zsim-head[data-level=running]").wait_for()
    assert federation.client().request("world/control", "stop")["ok"]
    run.ends(with_code=0)
    federation.nobody_left()
    page.get_by_text("the console has ended with its run").wait_for()
    assert page.locator("#zsim-head .title").text_content().startswith("run over")
    report_url, _ = [link.get_attribute("href") for link in page.locator("#zsim-head .files a").all()]
    report = page.evaluate("url => fetch(url).then(answer => answer.text())", report_url)
    assert "<h1>triad</h1>" in report
    with page.expect_download() as record:
        page.locator("#zsim-head .files a[download]").click()
    assert record.value.path().read_bytes() == (federation.out / "run.mcap").read_bytes()


@pytest.fixture
def waiting(federation: Federation) -> Iterator[Role]:
    """A finished run whose console waits for a page that copies nothing."""
    run = federation.run(TRIAD, "--console", "--rate", "2")
    address = run.line("steer at").text.rpartition(" ")[2]
    client, over, leaves = federation.client(), threading.Event(), threading.Event()

    def look() -> bool:
        request = urllib.request.Request(f"{address}head", headers={"X-Zsim-Page": "slow"})
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as head:
            return json.load(head)["leaves"]

    def keep_looking() -> None:
        with suppress(OSError):
            while not over.wait(LOOK_S):
                if look():
                    leaves.set()

    assert not look()
    page = threading.Thread(target=keep_looking)
    page.start()
    assert client.request("world/control", "stop")["ok"]
    run.line("may copy")
    assert leaves.wait(PATIENCE_S)
    yield run
    over.set()
    page.join(PATIENCE_S)


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 0), pytest.param(signal.SIGTERM, 0, marks=pytest.mark.soak), (signal.SIGKILL, -signal.SIGKILL)],
)
def test_a_signal_ends_a_run_that_waits_for_pages(
    federation: Federation, waiting: Role, number: int, code: int
) -> None:
    waiting.signal(number)
    waiting.ends(with_code=code)
    federation.nobody_left()


def test_a_console_takes_another_port_if_the_default_is_in_use(federation: Federation) -> None:
    links = [federation.role("console").line("steer at").text.rpartition(" ")[2] for _ in range(2)]
    assert links[0] != links[1]
    assert [status(link) for link in links] == [200, 200]


def test_report_and_record_are_served_once_they_exist(tmp_path: Path) -> None:
    with staged_console(StagedRun(past_s=0.5), tmp_path) as address:
        assert status(f"{address}report") == status(f"{address}view/record") == 404
        for name in ("report.html", "run.mcap"):
            (tmp_path / name).write_text(name)
        with (
            urllib.request.urlopen(f"{address}view/report") as report,
            urllib.request.urlopen(f"{address}record") as record,
        ):
            assert (report.read(), report.headers.get_content_type()) == (b"report.html", "text/html")
            assert (record.read(), record.headers.get_filename()) == (b"run.mcap", "run.mcap")
        with urllib.request.urlopen(f"{address}head") as head:
            assert all(each["size_bytes"] for each in json.load(head)["files"].values())


@pytest.mark.soak
def test_a_console_serves_consecutive_runs(federation: Federation) -> None:
    role, links = console(federation)
    world = federation.world(TRIAD, "--duration", "600")
    role.line("console.1: in run")
    shown(links["steer"], lambda state: state.get("clock") == "waiting")
    world.signal(signal.SIGINT)
    world.ends(with_code=0)
    role.line("console.1: left, the run ended")
    assert status(links["steer"]) == 200
    federation.world(TRIAD, "--duration", "600")
    first = role.line("console.1: in run").text
    role.line(f"console.1: in run (?!{first.rpartition(' ')[2]})")
    role.signal(signal.SIGINT)
    role.ends(with_code=0)


@pytest.mark.soak
def test_a_second_console_has_a_name_of_its_own(federation: Federation) -> None:
    federation.world(TRIAD, "--duration", "600")
    first, _ = console(federation)
    first.line("console.1: in run")
    second, _ = console(federation)
    second.line("console.2: in run")
    first.signal(signal.SIGINT)
    first.ends(with_code=0)
    third, _ = console(federation)
    third.line("console.1: in run")
    assert second.process.poll() is None


@pytest.mark.soak
def test_two_waiting_consoles_take_different_names(federation: Federation) -> None:
    consoles = [console(federation)[0] for _ in range(2)]
    for each in consoles:
        each.line("waiting for a world")
    federation.world(TRIAD, "--duration", "600")
    until_s = time.monotonic() + PATIENCE_S
    while {named(each) for each in consoles} != {"console.1", "console.2"}:
        assert time.monotonic() < until_s, [each.text() for each in consoles]
        time.sleep(POLL_MS / 1000)
    assert all(each.process.poll() is None for each in consoles)


def named(role: Role) -> str:
    """Return the name under which a console is in a run; empty before it joins."""
    return (re.findall(r"^(console\.\d+): in run", role.text(), re.MULTILINE) or [""])[-1]


def test_listening_to_other_hosts_requires_a_token(federation: Federation) -> None:
    role = federation.role("console", "--listen", "0.0.0.0", "--port", str(free_port()))
    role.ends(with_code=2)
    assert has_terms(role.text(), "0.0.0.0", "--token", "--listen 127.0.0.1")


def test_a_port_in_use_is_reported(federation: Federation) -> None:
    _, links = console(federation)
    port = urlsplit(links["steer"]).port
    other = federation.role("console", "--port", str(port))
    other.ends(with_code=2)
    assert has_terms(other.text(), "127.0.0.1", str(port))
