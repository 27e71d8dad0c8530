"""clients/js and examples/js in Node and in a browser."""

import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from chromium import needs_browser
from federation import ONE, Federation, free_port
from forked_commands import ROOT
from gateway_process import GatewayProcess
from refused import has_terms
from wire import PATIENCE_S

NODE = shutil.which("node")
SQUARE = ONE.replace("expect: []", "expect: [estimator.drone1, client.square]")
needs_node = pytest.mark.skipif(NODE is None, reason="node is not installed; on Debian: apt-get install nodejs")


def node(*arguments: object) -> str:
    """Run a script, which must succeed; return its output."""
    command = [str(NODE), *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 0, f"{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    assert done.stderr == ""
    return done.stdout


# In Node


@needs_node
def test_the_modules_own_tests_pass() -> None:
    output = node("--test", "--test-reporter=tap", "clients/js/tests/zsim.test.mjs")
    assert int(re.findall(r"^# pass (\d+)$", output, flags=re.MULTILINE)[0]) >= 11


@needs_node
def test_a_script_flies_a_square_in_lockstep(federation: Federation) -> None:
    world = federation.world(SQUARE, "--duration", "24")
    federation.role("estimator", "drone1")
    gateway = GatewayProcess(federation)
    output = node("examples/js/fly.mjs", f"tcp://127.0.0.1:{gateway.lines_port}")
    corners = [
        [float(n) for n in re.findall(r"-?\d+\.\d+", line)[:4]] for line in output.splitlines() if "corner" in line
    ]
    offsets = [(x - corners[0][1], y - corners[0][2]) for _, x, y, _ in corners]
    for offset, wanted in zip(offsets, [(0, 0), (2, 0), (2, 2), (0, 2), (0, 0)], strict=True):
        assert offset == pytest.approx(wanted, abs=0.6)  # two corners, each reached to 0.25 m
    assert all(z == pytest.approx(1.5, abs=0.3) for *_, z in corners)
    assert re.search(r"landed .*\d+\.\d\d s\n$", output)
    world.ends(with_code=0)


@needs_node
def test_a_script_without_a_gateway_reports_it() -> None:
    script = 'import { connect } from "./clients/js/zsim.js"; await connect("tcp://127.0.0.1:1", { timeoutS: 0.3 });'
    command = [str(NODE), "--input-type=module", "--eval", script]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 1
    assert has_terms(done.stderr, "tcp://127.0.0.1:1: ", "ECONNREFUSED")


@needs_node
def test_the_first_program_of_the_documentation_works(federation: Federation, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "clients-js.md").read_text()
    lines = re.findall(r"^    (import \{ connect \} .*\n(?:(?:    .*)?\n)*?    \}\);)\n\n", page, flags=re.MULTILINE)
    federation.world(ONE, "--duration", "600", "--rate", "4")
    gateway = GatewayProcess(federation)
    script = tmp_path / "first.mjs"
    text = textwrap.dedent(f"    {lines[0]}\n").replace("7470", str(gateway.lines_port))
    script.write_text(text.replace('"./clients', f'"{ROOT}/clients'))
    assert node(script) == "it hovers\n"


# In a browser

TOKEN = ("--token", "secret")  # required, as the page is not served from the gateway's port


@pytest.fixture
def served() -> Iterator[str]:
    """Serve the checkout as in docs/clients-js.md; yield the address of the page."""
    port = free_port()
    command = [sys.executable, "-m", "http.server", "--bind", "127.0.0.1", str(port)]
    env = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=env
    ) as server:
        assert server.stdout is not None
        assert "Serving HTTP" in server.stdout.readline()
        yield f"http://127.0.0.1:{port}/examples/js/index.html"
        server.kill()


class Watched:
    """A page with all its requests and errors."""

    def __init__(self, page: Any, address: str) -> None:
        self.page = page
        self.asked: list[str] = []
        self.faults: list[str] = []
        page.set_default_timeout(1000 * PATIENCE_S)
        page.on("request", lambda request: self.asked.append(request.url))
        page.on("websocket", lambda socket: self.asked.append(socket.url))
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.on("console", lambda output: self.faults.append(output.text) if output.type == "error" else None)
        page.goto(address)

    def press(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    def wait_for_text(self, pattern: str) -> None:
        """Wait until the page shows text that matches `pattern`."""
        try:
            self.page.get_by_text(re.compile(pattern)).first.wait_for()
        except Exception:
            pytest.fail(f"no {pattern!r} on the page, but:\n{self.page.inner_text('body')}\n{self.faults}")

    def map(self) -> str:
        """Return the canvas's picture as a data URL."""
        return self.page.evaluate("document.getElementById('map').toDataURL()")


HIGH = r"^-?[\d.]+ -?[\d.]+ (0\.[6-9]|1\.)"  # east, north, up
EAST = r"^(0\.[4-9]|[1-9]\.)"


@pytest.fixture
def opened(browser: Any, served: str) -> Iterator[Callable[..., Watched]]:
    """A function that opens the page on a gateway."""
    with ExitStack() as stack:

        def open_it(gateway: GatewayProcess, query: str = "&token=secret") -> Watched:
            context = browser.new_context(viewport={"width": 1000, "height": 700})
            stack.callback(context.close)
            return Watched(context.new_page(), f"{served}?gateway=ws://127.0.0.1:{gateway.http_port}/stream{query}")

        yield open_it


@pytest.mark.soak  # a browser starved of CPU for seconds loses control of its drone
@needs_browser
def test_the_page_shows_and_flies_a_drone(federation: Federation, opened: Callable[..., Watched]) -> None:
    patient = ["--set", "silence.hover_s=2", "--set", "silence.land_s=2"]  # allow for a slow page on a busy machine
    federation.world(ONE, "--rate", "1", "--duration", "600", *patient)
    gateway = GatewayProcess(federation, *TOKEN)
    other = federation.client()
    states = other.subscribe("drone/drone1/sensor/status")
    events = other.subscribe("world/event")
    seen = opened(gateway)
    seen.wait_for_text(r"run \w+, lockstep, as client\.page-\w+")
    seen.wait_for_text(r"^landed$")
    on_the_ground = seen.map()

    seen.press("Take off drone1")
    states.until(lambda m: m["state"] == "hovering")
    seen.wait_for_text(r"^hovering$")
    seen.wait_for_text(HIGH)

    t_ns = other.get("clock")["clock"]["t_ns"]
    velocity = {"source": "other.one", "velocity_m_s": [2.0, 0.0, 0.0], "yaw_rate_rad_s": 0.0, "frame": "world"}
    other.put("drone/drone1/cmd/velocity", t_ns=t_ns, **velocity)  # flown for 2 s, until silence.hover_s is over
    seen.wait_for_text(EAST)
    assert seen.map() != on_the_ground

    seen.press("Hold drone1")
    seen.wait_for_text(r", held$")
    page = states.until(lambda m: (m["commander"] or "").startswith("client.page-")).message["commander"]
    held_from_ns = states.now()[-1].message["t_ns"]
    states.until(lambda m: m["t_ns"] > held_from_ns + 5e9)  # longer than the limits on silence
    assert states.received[-1].message["state"] == "flying"
    other.put("drone/drone1/cmd/velocity", t_ns=t_ns, **velocity)
    assert page in events.until(lambda m: m["kind"] == "refused").message["text"]
    seen.wait_for_text("is flown by 'client.page-")  # the page shows the refusal, too

    seen.press("Let go drone1")
    events.until(lambda m: (m["kind"], m["subject"]) == ("control", "release"))
    seen.press("Land drone1")
    states.until(lambda m: m["state"] == "landed")
    seen.wait_for_text(r"^landed$")
    assert seen.faults == []
    assert {re.sub(r":\d+/.*", "", url) for url in seen.asked if not url.startswith("data:")} == {
        "http://127.0.0.1",
        "ws://127.0.0.1",
    }


@needs_browser
def test_the_page_survives_the_end_of_its_run_and_of_its_gateway(
    federation: Federation, opened: Callable[..., Watched]
) -> None:
    world = federation.world(ONE, "--rate", "2", "--duration", "600")
    gateway = GatewayProcess(federation, *TOKEN)
    seen = opened(gateway)
    seen.wait_for_text(r"^run \w+, lockstep")
    world.signal(2)
    world.ends(with_code=0)
    seen.wait_for_text(r"no run goes on")
    federation.world(ONE, "--rate", "2", "--duration", "600")
    seen.wait_for_text(r"^run \w+, lockstep")
    seen.wait_for_text(r"^landed$")
    gateway.role.signal(15)
    seen.wait_for_text(r"hung up|no gateway answers")


@needs_browser
@pytest.mark.soak
def test_the_page_shows_why_a_command_is_refused(federation: Federation, opened: Callable[..., Watched]) -> None:
    """A landed drone cannot be held; the page shows the world's reason and keeps working."""
    federation.world(ONE, "--rate", "2", "--duration", "600")
    seen = opened(GatewayProcess(federation, *TOKEN))
    seen.wait_for_text(r"^landed$")
    seen.press("Hold drone1")
    seen.wait_for_text("is landed; it accepts setpoints only while hovering or flying")
    assert seen.faults == []


@needs_browser
@pytest.mark.soak
def test_the_page_presents_its_token_to_the_gateway(federation: Federation, opened: Callable[..., Watched]) -> None:
    federation.world(ONE, "--rate", "2", "--duration", "600")
    gateway = GatewayProcess(federation, *TOKEN)
    opened(gateway, "").wait_for_text("no gateway answers there, or it wants a token")
    opened(gateway).wait_for_text(r"^landed$")
