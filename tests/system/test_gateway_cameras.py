"""Camera pictures as clients of the gateway see them: OpenCV, a browser and a client that does not read."""

import base64
import socket
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from chromium import needs_browser
from federation import PAIR, Federation
from gateway_process import GatewayProcess
from meanwhile import meanwhile
from picture_pump import PERIOD_S, SIZE, calibration, image, pumping, shaded
from refused import has_terms
from wire import PATIENCE_S, Client

FRONT = "drone/drone1/camera/front"
PICTURES = 12
LARGE = 300_000  # bytes, to fill the buffers of a connection quickly


class Pictures:
    """A connection to a picture stream that reads one picture per call of `next`."""

    def __init__(self, gateway: GatewayProcess, path: str) -> None:
        self._socket = socket.socket()
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
        self._socket.settimeout(PATIENCE_S)
        self._socket.connect(("127.0.0.1", gateway.http_port))
        self._socket.sendall(f"GET {path} HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n".encode())
        self._file = self._socket.makefile("rb")
        self.status = int(self._file.readline().split()[1])
        self.headers = self._read_headers()

    def next(self) -> tuple[int, bytes]:
        """Return the number and the JPEG data of the next picture."""
        while not self._file.readline().startswith(b"--"):
            pass
        headers = self._read_headers()
        data = self._file.read(int(headers["content-length"]))
        return round(float(headers["x-timestamp"]) * 1e3), data

    def _read_headers(self) -> dict[str, str]:
        found = {}
        while (line := self._file.readline().decode().strip()) != "":
            name, _, value = line.partition(": ")
            found[name.lower()] = value
        return found

    def __enter__(self) -> "Pictures":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._socket.close()


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Iterator[tuple[Federation, GatewayProcess]]:
    with Federation(tmp_path_factory.mktemp("cameras")) as federation:
        federation.world(PAIR.replace("duration_s: 12", "duration_s: 3600"), "--realtime", "--expect", "nobody.yet")
        yield federation, GatewayProcess(federation).in_run()


@pytest.fixture
def gateway(lab: tuple[Federation, GatewayProcess]) -> GatewayProcess:
    return lab[1]


@pytest.fixture
def camera(lab: tuple[Federation, GatewayProcess]) -> Client:
    return lab[0].client()


def test_opencv_reads_the_stream(gateway: GatewayProcess, camera: Client) -> None:
    with pumping(camera, FRONT):
        capture = cv2.VideoCapture(f"{gateway.url}/camera/drone1/front")
        shades = []
        while len(shades) < PICTURES:
            ok, picture = capture.read()
            assert ok
            assert picture.shape == (SIZE[1], SIZE[0], 3)
            shades.append(round(float(np.mean(picture)) / 16))
        capture.release()
    assert len(set(shades)) > 2  # the pictures differ


def test_pictures_arrive_as_published_with_their_times(gateway: GatewayProcess, camera: Client) -> None:
    with pumping(camera, FRONT), Pictures(gateway, "/camera/drone1/front") as stream:
        assert (stream.status, stream.headers["cache-control"]) == (200, "no-store")
        pictures = [stream.next() for _ in range(PICTURES)]
    assert [data for _, data in pictures] == [shaded(number) for number, _ in pictures]
    numbers = [number for number, _ in pictures]
    assert numbers == sorted(set(numbers))


def test_the_newest_picture_is_served_on_its_own(gateway: GatewayProcess, camera: Client) -> None:
    with pumping(camera, FRONT):
        answer = gateway.http("GET", "/camera/drone1/front.jpg")
    assert (answer.status, answer.headers["content-type"]) == (200, "image/jpeg")
    decoded = cv2.imdecode(np.frombuffer(answer.body, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert answer.body == shaded(round(float(answer.headers["x-timestamp"]) * 1e3))


def test_only_the_slow_client_loses_pictures(gateway: GatewayProcess, camera: Client) -> None:
    large = (640, 360)
    with (
        pumping(camera, FRONT, large, filler=LARGE),
        Pictures(gateway, "/camera/drone1/front") as slow,
        Pictures(gateway, "/camera/drone1/front") as other,
    ):
        first, _ = slow.next()
        numbers = [other.next()[0] for _ in range(4 * PICTURES)]
        seen = [first]
        while seen[-1] < numbers[-1]:
            seen.append(slow.next()[0])
    assert numbers == sorted(set(numbers))
    assert seen == sorted(set(seen))
    assert len(seen) < len(numbers) / 2


@pytest.mark.parametrize(
    ("path", "terms"),
    [
        ("/camera/drone1/side", ("camera", "'side'", "front", "bottom")),
        ("/camera/ghost/front", ("drone", "'ghost'", "drone1")),
        ("/camera/ghost/front.jpg", ("drone", "'ghost'", "drone1")),
        ("/camera/drone2/bottom.jpg", ("drone/drone2/camera/bottom", "picture")),
        ("/camera/drone1%2Fx/front", ("drone", "drone1")),
    ],
)
def test_an_unknown_camera_is_refused(gateway: GatewayProcess, path: str, terms: tuple[str, ...]) -> None:
    answer = gateway.http("GET", path)
    assert answer.status == 404
    assert has_terms(answer.json()["error"], *terms)


def test_other_methods_are_refused(gateway: GatewayProcess) -> None:
    answer = gateway.http("PUT", "/camera/drone1/front", {})
    assert (answer.status, answer.headers["allow"]) == (405, "GET")


JUNK = (
    Client.pack({"seq": 0, **image(0, b"GIF89a, which is no JPEG")}),
    Client.pack({"seq": 0, "t_ns": 0, "mode": "takeoff"}),
    b"\xc1",
)


def test_junk_on_a_cameras_key_is_counted_and_ignored(gateway: GatewayProcess, camera: Client) -> None:
    healths = camera.subscribe("process/gateway.main/health")
    before = healths.until(lambda health: True).message["refused"]
    with Pictures(gateway, "/camera/drone1/front") as stream:
        with pumping(camera, FRONT):
            stream.next()
        for junk in JUNK:  # the gateway's subscription has now reached the publisher
            camera.put_raw(FRONT, junk)
        with pumping(camera, FRONT):
            number, data = stream.next()
        assert data == shaded(number)
    counted = healths.until(lambda health: health["refused"] >= before + len(JUNK)).message["refused"]
    assert counted == before + len(JUNK)


def test_an_invalid_camera_info_is_ignored(gateway: GatewayProcess, camera: Client) -> None:
    path = f"/json/{FRONT}/info"
    healths = camera.subscribe("process/gateway.main/health")
    before = healths.until(lambda health: True).message["refused"]
    with gateway.events(path) as events:
        with meanwhile(lambda: camera.put(f"{FRONT}/info", **calibration()), PERIOD_S):
            _, first = next(events)  # the gateway's subscription has reached the publisher
        absurd = {**calibration(), "seq": 1, "source": "evil.cam", "width": 10**9, "K": [0.0] * 9}
        camera.put_raw(f"{FRONT}/info", Client.pack(absurd))
        healths.until(lambda health: health["refused"] > before)
        assert gateway.http("GET", path).json()["source"] == "camera.tester"
        camera.put(f"{FRONT}/info", **{**calibration(), "rate_hz": 7.0})
        shown = first["value"]
        while shown["rate_hz"] != 7.0:
            assert shown["source"] == "camera.tester"
            shown = next(events)[1]["value"]


def test_a_client_of_the_gateway_may_be_a_camera(gateway: GatewayProcess) -> None:
    text = base64.b64encode(shaded(3)).decode()
    value: dict[str, Any] = {"t_sample_ns": 10**12, "width": SIZE[0], "height": SIZE[1], "data": text}
    with Pictures(gateway, "/camera/drone1/bottom") as stream:
        assert gateway.http("PUT", "/json/drone/drone1/camera/bottom", value).status == 200
        assert stream.next() == (10**6, shaded(3))
    for data in ("no base64!", "R0lG"):
        answer = gateway.http("PUT", "/json/drone/drone1/camera/bottom", {**value, "data": data})
        assert answer.status == 400
        assert has_terms(answer.json()["error"], "drone/drone1/camera/bottom", "data", "JPEG")


def test_pictures_require_the_token(federation: Federation) -> None:
    federation.world(PAIR, "--realtime", "--expect", "nobody.yet")
    guarded = GatewayProcess(federation, "--token", "sesame").in_run()
    for path in ("/camera/drone1/front", "/camera/drone1/front.jpg", "/camera/drone1/front?token=wrong"):
        assert guarded.http("GET", path).status == 401
    with pumping(federation.client(), FRONT):
        ok, _ = cv2.VideoCapture(f"{guarded.url}/camera/drone1/front?token=sesame").read()
        assert ok
        assert guarded.http("GET", "/camera/drone1/front.jpg", headers={"Authorization": "Bearer sesame"}).status == 200


@needs_browser
@pytest.mark.soak
def test_a_browser_shows_the_stream(gateway: GatewayProcess, camera: Client, browser: Any) -> None:
    page = browser.new_context().new_page()
    page.set_default_timeout(1000 * PATIENCE_S)
    with pumping(camera, FRONT):
        page.goto(f"{gateway.url}/camera/drone1/front", wait_until="commit")
        page.wait_for_function("() => document.images.length && document.images[0].naturalWidth == 64")
    page.context.close()
