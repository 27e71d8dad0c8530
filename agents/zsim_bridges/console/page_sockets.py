"""Pictures for the pages that are open: each is sent what it asks for, when it has shown what it was sent before."""

import asyncio
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
from aiohttp import WSMsgType, web
from msgspec import Meta, Struct

from zsim_bridges.console.camera_feed import CameraFeed
from zsim_bridges.console.manual_flight import FlightAnswer, ManualFlight, Stick
from zsim_bridges.console.page_cameras import CameraFollow, CameraFrustums
from zsim_bridges.console.page_flying import PageFlying
from zsim_bridges.console.page_server import HEARTBEAT_S, OPERATOR
from zsim_bridges.console.time_monitor import RecordPlayer

NAME_MAX = 64  # characters of a drone's name, or of a page's
PLACE_MAX_M = 1e5  # of a place on the plan view; the fence is far nearer
SPEED_MAX_M_S = 100.0  # of a stick; the drones' own limits are far lower

Name = Annotated[str, Meta(max_length=NAME_MAX)]
Deflection = Annotated[float, Meta(ge=-1.0, le=1.0)]
Metres = Annotated[float, Meta(ge=-PLACE_MAX_M, le=PLACE_MAX_M)]


class _Action(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    pass


class LookFrom(_Action, frozen=True, tag="look"):
    """Let the page's camera follow the formation, keep all of it in view, and look from somewhere."""

    page: Name
    follows: bool
    fits: bool
    direction: Literal["", "reset", "top", "side"] = ""


class LookAtPlan(_Action, frozen=True, tag="plan"):
    """Send the view from above; `whole`: with what does not change."""

    page: Name
    whole: bool = False


class ChooseDrone(_Action, frozen=True, tag="choose"):
    """Choose a drone on the page itself."""

    page: Name
    drone: Name


class SelectDrone(_Action, frozen=True, tag="select"):
    """Select a drone on the page itself for one command with others, or no longer."""

    page: Name
    drone: Name


class PlayRecord(_Action, frozen=True, tag="play"):
    """Let a replay go on from an instant, pause, resume, do a step, or change its pace; of operators only."""

    op: Literal["seek", "pause", "resume", "step", "rate"]
    value: Annotated[float, Meta(ge=0.0, le=1e9)] = 1.0
    """Of seek simulated seconds, of step gates, of rate simulated per wall seconds."""


class TakeDrone(_Action, frozen=True, tag="take"):
    """Take a drone, to fly it; `over` from whoever flies it; of operators only, as all below.

    To be repeated until it is answered; what has the same `id` is carried out once.
    """

    drone: Name
    over: bool = False
    id: Name = ""


class SteerDrone(_Action, frozen=True, tag="steer"):
    """Fly the drone that was taken; not `held`: let it hover. To be repeated: who is silent does not fly."""

    held: bool = False
    forward: Deflection = 0.0
    left: Deflection = 0.0
    up: Deflection = 0.0
    turn: Deflection = 0.0
    speed_m_s: Annotated[float, Meta(ge=0.0, le=SPEED_MAX_M_S)] = 1.0

    def stick(self) -> Stick | None:
        """Return where the stick is, None where it is not held."""
        return Stick(self.forward, self.left, self.up, self.turn, self.speed_m_s) if self.held else None


class GoToPlace(_Action, frozen=True, tag="go"):
    """Send the drone that was taken to a place, at the height that it has unless `z_m` is given."""

    x_m: Metres
    y_m: Metres
    z_m: Metres | None = None


class LeaveDrone(_Action, frozen=True, tag="leave"):
    """Give the drone back."""


FlyDrone = TakeDrone | SteerDrone | GoToPlace | LeaveDrone
PageAction = LookFrom | LookAtPlan | ChooseDrone | SelectDrone | PlayRecord | FlyDrone
DECODER = msgspec.json.Decoder(PageAction)


ACTION_MAX = 2_000  # bytes

Answer = dict[str, Any]


class ActionSockets:
    """The sockets of all pages.

    Args:
        client_id: returns viser's number of a page, by the key that it was given; None of one that is not open.
        cameras: of all pages.
        record: returns what a replay plays, None without a run.
        flying: returns what pages may do with single drones, None without a run.
    """

    def __init__(
        self,
        client_id: Callable[[str], int | None],
        cameras: CameraFollow,
        record: Callable[[], RecordPlayer | None],
        flying: Callable[[], PageFlying | None] = lambda: None,
    ) -> None:
        self._client_id = client_id
        self._cameras = cameras
        self._record = record
        self._flying = flying
        self._keys: dict[Any, str] = {}  # of the page at each socket

    async def respond(self, request: web.Request, role: str) -> web.StreamResponse:
        """Answer a request for a socket; return when it has closed."""
        socket = web.WebSocketResponse(compress=False, max_msg_size=ACTION_MAX, heartbeat=HEARTBEAT_S)
        await socket.prepare(request)
        try:
            async for message in socket:
                answer = self.act(message.data, role, socket) if message.type is WSMsgType.TEXT else None
                if answer is None:
                    break
                if answer:
                    await socket.send_bytes(msgspec.json.encode(answer))
        except ConnectionError:
            pass  # the page has gone while it was answered
        finally:
            self.lose(socket)
        await socket.close()
        return socket

    def lose(self, page: Any) -> None:
        """Note that a page's socket is closed: what it flies hovers."""
        self._keys.pop(page, None)
        flying = self._flying()
        if flying is not None:
            flying.control.lose(page)

    def act(self, text: str, role: str, page: Any = None) -> Answer | None:
        """Do what a page says; return what it is answered, None where it is nothing that its role may do.

        Args:
            text: an action as JSON.
            role: of the page.
            page: identifies the page that flies a drone.
        """
        try:
            action: PageAction = DECODER.decode(text)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return None
        if isinstance(action, PlayRecord | FlyDrone):
            return self._operate(action, page) if role == OPERATOR else None
        if isinstance(action, LookAtPlan) and page is not None:
            self._keys[page] = action.page
        return self._look(action)

    def _look(self, action: LookFrom | LookAtPlan | ChooseDrone | SelectDrone) -> Answer:
        client_id, flying = self._client_id(action.page), self._flying()
        if isinstance(action, LookFrom):
            if client_id is not None:
                self._cameras.choose(client_id, action.follows, action.fits, action.direction)
        elif flying is not None and isinstance(action, LookAtPlan):
            return {"plan": flying.plan(client_id, action.whole)}
        elif flying is not None and isinstance(action, ChooseDrone):
            flying.choose(client_id, action.drone)
        elif flying is not None and isinstance(action, SelectDrone):
            flying.select(client_id, action.drone)
        return {}

    def _operate(self, action: PlayRecord | FlyDrone, page: Any) -> Answer:
        record, flying = self._record(), self._flying()
        if isinstance(action, PlayRecord):
            if record is not None:
                record.play(action.op, action.value)
            return {}
        if flying is None:
            return {}
        if isinstance(action, TakeDrone):
            client_id = self._client_id(self._keys.get(page, "")) if page is not None else None
            refusal = flying.take_refusal(client_id, action.drone)
            if refusal:
                return {"flight": FlightAnswer(action.drone, text=refusal)._asdict()}
        return {"flight": _fly(flying.control, page, action)._asdict()}


def _fly(control: ManualFlight, page: Any, action: FlyDrone) -> FlightAnswer:
    if isinstance(action, TakeDrone):
        return control.take(page, action.drone, action.over, action.id)
    if isinstance(action, SteerDrone):
        return control.steer(page, action.stick())
    if isinstance(action, GoToPlace):
        return control.go(page, action.x_m, action.y_m, action.z_m)
    return control.leave(page)


PERIOD_S = 0.1  # wall, from a picture of a camera to the next, at least
WANTED_MAX = 16  # pictures on one page
REQUEST_MAX = 10_000  # bytes


class PicturesRequest(Struct, frozen=True, forbid_unknown_fields=True):
    """What a page asks for; each request is also the word that it has shown what it was sent before."""

    page: Name = ""
    want: Annotated[tuple[Name, ...], Meta(max_length=WANTED_MAX)] = ()
    frustum: Name = ""
    """The camera whose frustum is shown in the page's scene; empty for none."""


_DECODER = msgspec.json.Decoder(PicturesRequest)
NOTHING = PicturesRequest()


class PageBatches:
    """What one page is sent: of each camera what has changed since, all in one message.

    A message is the length of its header (4 bytes, big-endian), the header as JSON, and the JPEGs one after the other.
    The header has `cameras` (name, width, height; null if they are as before) and `pictures` (camera, size [bytes; 0:
    the picture is as before], t_s, marks), and `clicked` where a drone was clicked in the scene.
    """

    def __init__(self) -> None:
        self._cameras: list[dict[str, Any]] = []
        self._shown: dict[str, tuple[Any, ...]] = {}

    def next(self, feed: CameraFeed | None, want: tuple[str, ...], clicked: str = "") -> bytes | None:
        """Return the next message, None while nothing has changed and no drone was clicked."""
        listed = self._listed(feed)
        pictures = [] if feed is None else [self._picture(feed, camera) for camera in dict.fromkeys(want)]
        changed = [each for each in pictures if each is not None]
        if listed is None and not changed and not clicked:
            return None
        told = {"cameras": listed, "pictures": [entry for entry, _ in changed]}
        header = msgspec.json.encode({**told, "clicked": clicked} if clicked else told)
        return b"".join((len(header).to_bytes(4, "big"), header, *(data for _, data in changed)))

    def _listed(self, feed: CameraFeed | None) -> list[dict[str, Any]] | None:
        """Return the cameras that there are, None if they are as before."""
        found = [] if feed is None else feed.cameras()
        cameras = [{"name": name, "width": info.width, "height": info.height} for name, info in found]
        if cameras == self._cameras:
            return None
        self._cameras, self._shown = cameras, {}
        return cameras

    def _picture(self, feed: CameraFeed, camera: str) -> tuple[dict[str, Any], bytes] | None:
        """Return what has changed of a picture, None if nothing has."""
        picture = feed.picture(camera)
        if picture is None:
            return None
        shown, marks = self._shown.get(camera), feed.marks(camera)
        now = (feed, picture.number, marks)
        if shown == now:
            return None
        self._shown[camera] = now
        data = b"" if shown is not None and shown[:2] == now[:2] else picture.image.data
        t_s = picture.image.t_sample_ns / 1e9
        return {"camera": camera, "size": len(data), "t_s": t_s, "marks": marks}, data


class CameraSockets:
    """The sockets of all pages.

    Args:
        feed: returns the cameras of the run that is shown, None without one.
        frustums: in the scenes of the pages.
    """

    def __init__(self, feed: Callable[[], CameraFeed | None], frustums: CameraFrustums) -> None:
        self._feed = feed
        self._frustums = frustums

    async def respond(self, request: web.Request) -> web.StreamResponse:
        """Answer a request for a socket; return when it has closed."""
        socket = web.WebSocketResponse(compress=False, max_msg_size=REQUEST_MAX, heartbeat=HEARTBEAT_S)
        await socket.prepare(request)
        await self.serve(socket)
        await socket.close()
        return socket

    async def serve(self, socket: web.WebSocketResponse) -> None:
        """Send pictures until the page closes its socket."""
        page = _Page(socket, self._feed, self._frustums)
        sending = asyncio.ensure_future(page.send())
        try:
            await page.receive()
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            page.leave()


class _Page:
    """One page and its socket."""

    def __init__(
        self,
        socket: web.WebSocketResponse,
        feed: Callable[[], CameraFeed | None],
        frustums: CameraFrustums,
    ) -> None:
        self._socket = socket
        self._feed = feed
        self._frustums = frustums
        self._request = NOTHING
        self._ready = asyncio.Event()

    async def receive(self) -> None:
        """Take requests until the socket closes, or says what is none."""
        async for message in self._socket:
            if message.type is not WSMsgType.TEXT:
                return
            try:
                self._request = _DECODER.decode(message.data)
            except (msgspec.MsgspecError, ValueError, RecursionError):
                return
            self._frustums.choose(self._request.page, self._request.frustum)
            self._ready.set()

    async def send(self) -> None:
        """Send what has changed, no oftener than PERIOD_S, and nothing before the page has shown the last."""
        batches = PageBatches()
        while True:
            await self._ready.wait()
            feed, want = self._feed(), self._request.want
            if feed is not None:
                feed.ask(self, (*want, self._request.frustum) if self._request.frustum else want)
            batch = batches.next(feed, want, self._frustums.take_click(self._request.page))
            if batch is not None:
                self._ready.clear()
                await self._socket.send_bytes(batch)
            await asyncio.sleep(PERIOD_S)

    def leave(self) -> None:
        """Show and ask for nothing any more."""
        self._frustums.choose(self._request.page, "")
        feed = self._feed()
        if feed is not None:
            feed.release(self)
