"""viser's server, on a port of loopback that refuses connections without a secret."""

import asyncio
import contextlib
import http
import io
import secrets
from collections.abc import Callable, Iterator
from typing import Any

import viser
import viser.infra._infra
import websockets.asyncio.server
from viser._messages import GuiUpdateMessage
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from zsim_bridges.console.server.http_proxy import BACKEND_HOST, SECRET_HEADER


class AnyThreadEvent(asyncio.Event):
    """An event that other threads may set; the loop's own `set` wakes the tasks that wait.

    An asyncio.Event iterates over its waiters, and fails when the loop changes them meanwhile.
    """

    def set(self) -> None:
        """Set it; on the loop, wake the waiters even if another thread has set it before."""
        if asyncio._get_running_loop() is None:
            self._value = True
        else:
            self._value = False
            super().set()


class _Buffer(AsyncMessageBuffer):
    """A buffer of viser's, which sets its event from every thread, and once more on the loop."""

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self.message_event = AnyThreadEvent()


viser.infra._infra.AsyncMessageBuffer = _Buffer  # type: ignore[misc]


Permits = Callable[[int, str], bool]
"""Returns whether a page, by viser's number of it, may use a control of all pages, by its id."""


class PrivateViser:
    """A viser server on a port of loopback that refuses connections without the secret.

    Args:
        permits: a use that it does not permit changes nothing, and the page shows the value of before again.

    Attributes:
        server: viser's.
        secret: to be sent in SECRET_HEADER.
    """

    def __init__(self, permits: Permits = lambda *_: True) -> None:
        self.secret = secrets.token_urlsafe(24)
        with _silent(), _requiring_secret(self.secret):
            self.server = viser.ViserServer(host=BACKEND_HOST, port=0, verbose=False)
        _guard_controls(self.server, permits)

    @property
    def port(self) -> int:
        return self.server.get_port()

    def close(self) -> None:
        """Stop it."""
        with _silent():
            self.server.stop()


def _guard_controls(server: viser.ViserServer, permits: Permits) -> None:
    """Look at each use of a control before viser does: it shares controls, and cannot refuse one to a page."""
    handle_update, pages = server.gui._handle_gui_updates, server.gui._websock_interface

    async def guarded(client_id: Any, message: GuiUpdateMessage) -> None:
        if permits(client_id, message.uuid):
            await handle_update(client_id, message)
            return
        control: Any = server.gui._gui_input_handle_from_uuid.get(message.uuid)
        page = server.get_clients().get(client_id)
        if control is not None and page is not None and not control._impl.is_button:
            before = GuiUpdateMessage(message.uuid, {"value": control.value})
            page.gui._websock_interface.queue_message(before)

    pages.unregister_handler(GuiUpdateMessage, handle_update)
    pages.register_handler(GuiUpdateMessage, guarded)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep viser from printing an address that is of no use to a person."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


@contextlib.contextmanager
def _requiring_secret(secret: str) -> Iterator[None]:
    """Let servers that are started meanwhile refuse connections without the secret: viser has no setting for it."""
    serve = websockets.asyncio.server.serve

    def serve_checked(*args: Any, process_request: Callable[..., Any] | None = None, **more: Any) -> Any:
        def check(connection: Any, request: Request) -> Response | None:
            if not secrets.compare_digest(request.headers.get(SECRET_HEADER, ""), secret):
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", Headers(), b"")
            return None

        return serve(*args, process_request=check, **more)

    websockets.asyncio.server.serve = serve_checked  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
