"""The two sockets that each page opens: one for actions, one for pictures from the drones' cameras.

Pictures have a separate socket, since a megabyte of them on a slow link must not delay the answers to a stick. A socket
is closed on an invalid or forbidden message. Viewers may look and choose; operators may also fly and play records.
"""

import asyncio
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
from aiohttp import WSMsgType, web
from msgspec import Meta, Struct

from zsim_bridges.console.camera_feed import CameraFeed
from zsim_bridges.console.manual_flight import FlightAnswer, PageFlying, Stick
from zsim_bridges.console.page_cameras import PageCameras
from zsim_bridges.console.page_server import HEARTBEAT_S, OPERATOR
from zsim_bridges.console.run_monitor import RecordPlayer

ACTION_MAX = 2_000  # maximum size of an action [bytes]
NAME_MAX = 64  # maximum number of characters of a drone's or camera's name, or of a page's key
COORDINATE_MAX_M = 1e5  # maximum coordinate on the plan view; the fence is much nearer
SPEED_MAX_M_S = 100.0  # maximum speed that a stick may demand; the drones' own limits are much lower
PERIOD_S = 0.1  # wall; minimum time between two messages with pictures
WANTED_MAX = 16  # maximum number of pictures on one page
REQUEST_MAX = 10_000  # maximum size of a request [bytes]

Name = Annotated[str, Meta(max_length=NAME_MAX)]
Deflection = Annotated[float, Meta(ge=-1.0, le=1.0)]
Metres = Annotated[float, Meta(ge=-COORDINATE_MAX_M, le=COORDINATE_MAX_M)]


class _Action(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    pass


class LookFrom(_Action, frozen=True, tag="look"):
    """Set whether the page's camera follows the formation and keeps all of it in view, and look from `direction`."""

    page: Name
    follows: bool
    fits: bool
    direction: Literal["", "reset", "top", "side"] = ""


class LookAtPlan(_Action, frozen=True, tag="plan"):
    """Request the plan view; with `whole`, including the constant part and the past trails."""

    page: Name
    whole: bool = False


class ChooseDrone(_Action, frozen=True, tag="choose"):
    """Choose a drone on this page only."""

    page: Name
    drone: Name


class SelectDrone(_Action, frozen=True, tag="select"):
    """On this page only, select a drone for a command to several drones, or deselect it."""

    page: Name
    drone: Name


class PlayRecord(_Action, frozen=True, tag="play"):
    """Seek in a replay, pause, resume or step it, or change its rate; for operators only."""

    op: Literal["seek", "pause", "resume", "step", "rate"]
    value: Annotated[float, Meta(ge=0.0, le=1e9)] = 1.0
    """The simulated time to seek [s], the number of gates to step, or the rate [× real time]; otherwise unused."""


class TakeDrone(_Action, frozen=True, tag="take"):
    """Take a drone to fly it; with `over`, even from its present commander; for operators only, like all actions below.

    The page repeats this action until it is answered; it is carried out once per `id`.
    """

    drone: Name
    over: bool = False
    id: Name = ""


class SteerDrone(_Action, frozen=True, tag="steer"):
    """Fly the taken drone while `held`; otherwise it hovers, or continues to its waypoints.

    The page repeats this action, since the drone of a silent page hovers.
    """

    held: bool = False
    forward: Deflection = 0.0
    left: Deflection = 0.0
    up: Deflection = 0.0
    turn: Deflection = 0.0
    speed_m_s: Annotated[float, Meta(ge=0.0, le=SPEED_MAX_M_S)] = 1.0


class GoToPoint(_Action, frozen=True, tag="go"):
    """Send the taken drone to a point in W, at the drone's present height unless `z_m` is given.

    `then`: append the point to the present waypoints instead of replacing them.
    """

    x_m: Metres
    y_m: Metres
    z_m: Metres | None = None
    then: bool = False


class LeaveDrone(_Action, frozen=True, tag="leave"):
    """Release the taken drone."""


_ViewAction = LookFrom | LookAtPlan | ChooseDrone | SelectDrone
_OperatorAction = PlayRecord | TakeDrone | SteerDrone | GoToPoint | LeaveDrone
_ACTIONS = msgspec.json.Decoder(_ViewAction | _OperatorAction)


class ActionSockets:
    """The action sockets of all pages.

    `record` returns the player of a run's record, and `flying` the control of its single drones; None without a run.
    """

    def __init__(
        self,
        cameras: PageCameras,
        record: Callable[[], RecordPlayer | None],
        flying: Callable[[], PageFlying | None] = lambda: None,
    ) -> None:
        self._cameras = cameras
        self._record = record
        self._flying = flying
        self._keys: dict[Any, str] = {}  # keys of pages, by their sockets

    async def respond(self, request: web.Request, role: str) -> web.StreamResponse:
        """Answer a request for a socket; return when it is closed."""
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
            pass  # the page closed before it was answered
        finally:
            self.lose(socket)
        await socket.close()
        return socket

    def lose(self, page: Any) -> None:
        """Record that a page's socket is closed, so that the drone that the page flies hovers."""
        self._keys.pop(page, None)
        flying = self._flying()
        if flying is not None:
            flying.control.lose(page)

    def act(self, text: str, role: str, page: Any = None) -> dict[str, Any] | None:
        """Carry out a page's action (JSON) in a role; return the answer, None if the action is invalid or forbidden.

        `page`, its socket, identifies the page that flies a drone.
        """
        try:
            action: _ViewAction | _OperatorAction = _ACTIONS.decode(text)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return None
        flying = self._flying()
        if isinstance(action, _OperatorAction):
            return self._operate(action, page, flying) if role == OPERATOR else None
        client_id = self._cameras.client_id(action.page)
        if isinstance(action, LookAtPlan) and page is not None:
            self._keys[page] = action.page
        if isinstance(action, LookFrom):
            if client_id is not None:
                self._cameras.look(client_id, action.follows, action.fits, action.direction)
        elif flying is None:
            return {}
        elif isinstance(action, LookAtPlan):
            return {"plan": flying.plan(client_id, action.whole)}
        elif isinstance(action, ChooseDrone):
            flying.pages.choose(client_id, action.drone)
        else:
            flying.pages.toggle(client_id, action.drone)
        return {}

    def _operate(self, action: _OperatorAction, page: Any, flying: PageFlying | None) -> dict[str, Any]:
        if isinstance(action, PlayRecord):
            record = self._record()
            if record is not None:
                record.play(action.op, action.value)
            return {}
        if flying is None:
            return {}
        if isinstance(action, TakeDrone):
            client_id = self._cameras.client_id(self._keys.get(page, "")) if page is not None else None
            refusal = flying.pages.use(client_id, action.drone)
            if refusal:
                answer = FlightAnswer(action.drone, text=refusal)
            else:
                answer = flying.control.take(page, action.drone, action.over, action.id)
        elif isinstance(action, SteerDrone):
            deflections = action.forward, action.left, action.up, action.turn
            answer = flying.control.steer(page, Stick(*deflections, action.speed_m_s) if action.held else None)
        elif isinstance(action, GoToPoint):
            answer = flying.control.go(page, action.x_m, action.y_m, action.z_m, action.then)
        else:
            answer = flying.control.leave(page)
        return {"flight": answer._asdict()}


# Pictures


class PicturesRequest(Struct, frozen=True, forbid_unknown_fields=True):
    """A page's request for pictures; it also confirms that the page has shown the previous message."""

    page: Name = ""
    want: Annotated[tuple[Name, ...], Meta(max_length=WANTED_MAX)] = ()
    frustum: Name = ""
    """The camera whose frustum is shown in the page's scene; empty for none."""


_PICTURES = msgspec.json.Decoder(PicturesRequest)


class PageBatches:
    """The messages with pictures for one page: each contains all changes of the requested cameras since the last one.

    A message is the length of its header (4 bytes, big-endian), the header as JSON, and the JPEGs in succession.
    The header has `cameras` (name, width, height; null if unchanged), `pictures` (camera, size [bytes; 0: unchanged],
    t_s, marks), and `clicked` if a drone was clicked in the scene.
    """

    def __init__(self) -> None:
        self._cameras: list[dict[str, Any]] = []
        self._sent: dict[str, tuple[Any, ...]] = {}

    def next(self, feed: CameraFeed | None, want: tuple[str, ...], clicked: str = "") -> bytes | None:
        """Return the next message, None while nothing has changed and no drone was clicked."""
        feed_cameras = [] if feed is None else feed.cameras()
        cameras = [{"name": name, "width": info.width, "height": info.height} for name, info in feed_cameras]
        header: dict[str, Any] = {"cameras": None, "pictures": []}
        if cameras != self._cameras:
            self._cameras, self._sent, header["cameras"] = cameras, {}, cameras
        jpegs = []
        for camera in dict.fromkeys(want):
            picture = feed.picture(camera) if feed is not None else None
            if feed is None or picture is None:
                continue
            sent, newest = self._sent.get(camera), (feed, picture.number, feed.marks(camera))
            if sent == newest:
                continue
            self._sent[camera] = newest
            data = b"" if sent is not None and sent[:2] == newest[:2] else picture.image.data
            t_s = picture.image.t_sample_ns / 1e9
            header["pictures"].append({"camera": camera, "size": len(data), "t_s": t_s, "marks": newest[2]})
            jpegs.append(data)
        if header["cameras"] is None and not header["pictures"] and not clicked:
            return None
        encoded = msgspec.json.encode({**header, "clicked": clicked} if clicked else header)
        return b"".join((len(encoded).to_bytes(4, "big"), encoded, *jpegs))


class CameraSockets:
    """The picture sockets of all pages; `feed` returns the cameras of the run that is shown, None without one."""

    def __init__(self, feed: Callable[[], CameraFeed | None], cameras: PageCameras) -> None:
        self._feed = feed
        self._cameras = cameras

    async def respond(self, request: web.Request) -> web.StreamResponse:
        """Answer a request for a socket; return when it is closed."""
        socket = web.WebSocketResponse(compress=False, max_msg_size=REQUEST_MAX, heartbeat=HEARTBEAT_S)
        await socket.prepare(request)
        await self.serve(socket)
        await socket.close()
        return socket

    async def serve(self, socket: web.WebSocketResponse) -> None:
        """Send pictures until the page closes its socket or sends an invalid request.

        Only changes are sent, at least PERIOD_S apart, and none before the page has shown the previous ones.
        """
        request, ready = PicturesRequest(), asyncio.Event()

        async def send() -> None:
            batches = PageBatches()
            while True:
                await ready.wait()
                feed, want = self._feed(), request.want
                if feed is not None:
                    feed.request_pictures(socket, (*want, request.frustum) if request.frustum else want)
                batch = batches.next(feed, want, self._cameras.pop_click(request.page))
                if batch is not None:
                    ready.clear()
                    await socket.send_bytes(batch)
                await asyncio.sleep(PERIOD_S)

        sending = asyncio.ensure_future(send())
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT:
                    break
                try:
                    request = _PICTURES.decode(message.data)
                except (msgspec.MsgspecError, ValueError, RecursionError):
                    break
                self._cameras.show_frustum(request.page, request.frustum)
                ready.set()
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            self._cameras.show_frustum(request.page, "")
            feed = self._feed()
            if feed is not None:
                feed.release(socket)
