"""What a page does in its scene, over a socket of its own: where its camera looks from, what of a record is played."""

from collections.abc import Callable
from typing import Annotated, Literal

import msgspec
from aiohttp import WSMsgType, web
from msgspec import Meta, Struct

from zsim_bridges.console.record_player import RecordPlayer
from zsim_bridges.console.scene.camera_follow import CameraFollow
from zsim_bridges.console.server.page_tokens import OPERATOR

ACTION_MAX = 2_000  # bytes
HEARTBEAT_S = 20.0  # after which a page on a machine that is gone is noticed
NAME_MAX = 64  # characters of a drone's name, or of a page's

Name = Annotated[str, Meta(max_length=NAME_MAX)]


class LookFrom(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="look"):
    """Let the page's camera follow the formation, keep all of it in view, and look from somewhere."""

    page: Name
    follows: bool
    fits: bool
    direction: Literal["", "reset", "top", "side"] = ""


class PlayRecord(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="play"):
    """Let a replay go on from an instant, pause, resume, do a step, or change its pace; of operators only."""

    op: Literal["seek", "pause", "resume", "step", "rate"]
    value: Annotated[float, Meta(ge=0.0, le=1e9)] = 1.0
    """Of seek simulated seconds, of step gates, of rate simulated per wall seconds."""


_DECODER = msgspec.json.Decoder(LookFrom | PlayRecord)


class ActionSockets:
    """The sockets of all pages.

    Args:
        client_id: returns viser's number of a page, by the key that it was given; None of one that is not open.
        cameras: of all pages.
        record: returns what a replay plays, None without a run.
    """

    def __init__(
        self,
        client_id: Callable[[str], int | None],
        cameras: CameraFollow,
        record: Callable[[], RecordPlayer | None],
    ) -> None:
        self._client_id = client_id
        self._cameras = cameras
        self._record = record

    async def respond(self, request: web.Request, role: str) -> web.StreamResponse:
        """Answer a request for a socket; return when it has closed."""
        socket = web.WebSocketResponse(compress=False, max_msg_size=ACTION_MAX, heartbeat=HEARTBEAT_S)
        await socket.prepare(request)
        async for message in socket:
            if message.type is not WSMsgType.TEXT or not self.act(message.data, role):
                break
        await socket.close()
        return socket

    def act(self, text: str, role: str) -> bool:
        """Do what a page says; return whether it is something that its role may do."""
        try:
            action = _DECODER.decode(text)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return False
        if isinstance(action, PlayRecord):
            return role == OPERATOR and self._play(action)
        client_id = self._client_id(action.page)
        if client_id is not None:
            self._cameras.choose(client_id, action.follows, action.fits, action.direction)
        return True

    def _play(self, action: PlayRecord) -> bool:
        record = self._record()
        if record is not None:
            record.play(action.op, action.value)
        return True
