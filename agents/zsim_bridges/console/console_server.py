"""The console: shows one run after the other on a viser server that only its own HTTP proxy can reach."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import viser

from zsim.contract.messages import Info
from zsim.runtime.participant import Participant
from zsim.transport.session import Session
from zsim_bridges.console.flying.page_flying import PageFlying
from zsim_bridges.console.monitoring.page_head import no_run_head
from zsim_bridges.console.orders import OrderRequest
from zsim_bridges.console.record_player import RecordPlayer
from zsim_bridges.console.run_page import RunPage
from zsim_bridges.console.scene.camera_follow import CameraFollow
from zsim_bridges.console.scene.camera_frustums import CameraFrustums
from zsim_bridges.console.server.action_socket import ActionSockets
from zsim_bridges.console.server.camera_socket import CameraSockets
from zsim_bridges.console.server.http_proxy import HttpProxy, ListenAddress, ViserBackend
from zsim_bridges.console.server.page_messages import PageControls, is_permitted
from zsim_bridges.console.server.page_tokens import OPERATOR, VIEWER
from zsim_bridges.console.server.private_viser import PrivateViser
from zsim_bridges.console.server.run_files import RunFiles

REASON_S = 0.1  # wall; between two looks for a reason to end
OFFER_S = 20.0  # wall; how long pages may take to copy what a run left behind: 100 MB over Wi-Fi of 40 Mbit/s


class Console:
    """One console.

    Args:
        address: where pages are served.
        name: process name.
        token: of operators; None on this machine alone.
        rate_hz: pictures a second; None: as many as suit the number of drones.
        say: prints a line.
        world: where a run is looked for, in words.
        folder: where the run that is shown is recorded, as far as that is known here.

    Raises:
        RunError: others could reach it, and there is no token.
    """

    def __init__(
        self,
        address: ListenAddress,
        name: str,
        token: str | None,
        rate_hz: float | None,
        say: Callable[[str], None],
        world: str = "",
        folder: Path | None = None,
    ) -> None:
        self._files = RunFiles(folder)
        self._name = name
        self._world = world
        self._ended = ""
        self._rate_hz = rate_hz
        self._say = say
        self._run_page: RunPage | None = None
        self._viser = PrivateViser(self._permits)
        self._camera_follow = CameraFollow(self._viser.server)
        self._frustums = CameraFrustums(self._viser.server)
        _show_text(self._viser.server.gui, f"Waiting for a world: {world}" if world else "Waiting for a world")
        controls = PageControls(self._viser.server.gui, self._pages)
        permits = partial(is_permitted, controls=controls)
        sockets = CameraSockets(lambda: self._run_page and self._run_page.cameras, self._frustums)
        actions = ActionSockets(self._frustums.client_id, self._camera_follow, self._record, self._flying)
        answers = permits, sockets.respond, actions.respond, self._head, self._command, self._files, self._looked
        backend = ViserBackend(self._viser.port, self._viser.secret, self._state, *answers)
        self._proxy = HttpProxy(address, token, backend)

    @contextmanager
    def open(self) -> Iterator[None]:
        """Serve pages.

        Raises:
            RunError: the port is taken.
        """
        try:
            with self._proxy.open():
                urls = self._proxy.urls()
                self._say(f"{self._name}: steer at {urls[OPERATOR]}")
                self._say(f"{self._name}: look, without steering, at {urls[VIEWER]}")
                yield
        finally:
            self._viser.close()

    def serve(
        self,
        link: Session,
        info: Info,
        observer: Participant,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        """Show a run until it is over or `stopped` returns true."""
        shown_by = self._camera_follow, self._frustums, self._rate_hz, self._world
        self._run_page = page = RunPage(self._viser.server, link, info, observer, *shown_by)
        try:
            page.run(stopped)
        finally:
            page.close()

    def remain(self, end_reason: Callable[[], str | None], deserted: Callable[[], bool]) -> None:
        """Serve the pages of a run that is over until there is a reason to end, and they have copies of its files.

        Args:
            end_reason: returns it, None while there is none.
            deserted: whether nobody waits for this process any more: then pages are not waited for.
        """
        while not (reason := end_reason()):
            time.sleep(REASON_S)
        self._ended = reason
        if self._run_page:
            self._run_page.end(reason)
        self._files.offer(OFFER_S, deserted)

    def _record(self) -> RecordPlayer | None:
        return self._run_page.record if self._run_page else None

    def _flying(self) -> PageFlying | None:
        return self._run_page.flying if self._run_page else None

    def _permits(self, client_id: int, control: str) -> bool:
        return self._run_page is None or self._run_page.permits(client_id, control)

    def _looked(self, key: str, role: str, address: str) -> None:
        client_id = self._frustums.client_id(key)
        if self._run_page and client_id is not None:
            self._run_page.desk.look(client_id, role, address)

    def _pages(self) -> list[viser.GuiApi]:
        return [page.gui for page in self._viser.server.get_clients().values()]

    def _state(self) -> dict[str, Any]:
        return self._run_page.state() if self._run_page else {"run_id": None}

    def _head(self) -> dict[str, Any]:
        return self._run_page.head() if self._run_page else no_run_head(self._world, self._ended)

    def _command(self, request: OrderRequest) -> dict[str, Any]:
        if self._run_page:
            return self._run_page.command(request)
        return {"id": request.id, "op": request.op, "state": "refused", "reason": "there is no run yet"}


def _show_text(gui: viser.GuiApi, text: str) -> None:
    """Show a line on pages without a run."""
    gui.configure_theme(show_logo=False, show_share_button=False)
    gui.set_panel_label("zsim")
    gui.add_markdown(text)
