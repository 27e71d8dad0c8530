"""The socket over which a page says what it does in its scene; viewers look and choose, operators fly and play."""

from collections.abc import Callable
from typing import Any

import msgspec
from aiohttp import WSMsgType, web

from zsim_bridges.console.flying.flight_conditions import FlightAnswer
from zsim_bridges.console.flying.manual_flight import ManualFlight
from zsim_bridges.console.flying.page_flying import PageFlying
from zsim_bridges.console.record_player import RecordPlayer
from zsim_bridges.console.scene.camera_follow import CameraFollow
from zsim_bridges.console.server.http_proxy import HEARTBEAT_S
from zsim_bridges.console.server.page_actions import (
    DECODER,
    ChooseDrone,
    FlyDrone,
    GoToPlace,
    LookAtPlan,
    LookFrom,
    PageAction,
    PlayRecord,
    SelectDrone,
    SteerDrone,
    TakeDrone,
)
from zsim_bridges.console.server.page_tokens import OPERATOR

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
