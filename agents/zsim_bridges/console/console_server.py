"""The console: shows one run after the other on a viser server that only its own HTTP server can reach."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from zsim.contract.messages import Info
from zsim.runtime.participant import Participant
from zsim.transport.session import Session
from zsim_bridges.console.control_desk import OPERATOR, VIEWER
from zsim_bridges.console.orders import OrderRequest
from zsim_bridges.console.page_cameras import CameraFollow, CameraFrustums
from zsim_bridges.console.page_server import HttpProxy, ListenAddress, RunFiles, ViserBackend
from zsim_bridges.console.page_sockets import ActionSockets, CameraSockets
from zsim_bridges.console.private_viser import PageControls, PrivateViser, is_permitted
from zsim_bridges.console.run_condition import no_run_head
from zsim_bridges.console.run_page import RunPage

REASON_S = 0.1  # wall; between two looks for a reason to end
OFFER_S = 20.0  # wall; how long pages may take to copy what a run left behind: 100 MB over Wi-Fi of 40 Mbit/s


class Console:
    """One console.

    Args:
        token: of operators; None on this machine alone.
        rate_hz: pictures a second; None: by the number of drones.
        world: where a run is looked for, in words.
        folder: where the run that is shown is recorded, if known here.

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
        self._viser = PrivateViser(lambda *use: self._run_page is None or self._run_page.permits(*use))
        server = self._viser.server
        self._camera_follow = CameraFollow(server)
        self._frustums = CameraFrustums(server)
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.set_panel_label("zsim")
        server.gui.add_markdown(f"Waiting for a world: {world}" if world else "Waiting for a world")
        controls = PageControls(server.gui, lambda: [page.gui for page in server.get_clients().values()])
        cameras = CameraSockets(lambda: self._run_page and self._run_page.cameras, self._frustums)
        actions = ActionSockets(
            self._frustums.client_id,
            self._camera_follow,
            lambda: self._run_page and self._run_page.record,
            lambda: self._run_page and self._run_page.flying,
        )
        backend = ViserBackend(
            port=self._viser.port,
            secret=self._viser.secret,
            state=lambda: self._run_page.state() if self._run_page else {"run_id": None},
            permits=partial(is_permitted, controls=controls),
            serve_cameras=cameras.respond,
            serve_actions=actions.respond,
            head=lambda: self._run_page.head() if self._run_page else no_run_head(self._world, self._ended),
            command=self._command,
            files=self._files,
            looked=self._on_look,
        )
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
            deserted: whether nobody waits for this process any more, so that pages are not waited for.
        """
        while not (reason := end_reason()):
            time.sleep(REASON_S)
        self._ended = reason
        if self._run_page:
            self._run_page.end(reason)
        self._files.offer(OFFER_S, deserted)

    def _on_look(self, key: str, role: str, address: str) -> None:
        client_id = self._frustums.client_id(key)
        if self._run_page and client_id is not None:
            self._run_page.desk.look(client_id, role, address)

    def _command(self, request: OrderRequest) -> dict[str, Any]:
        if self._run_page:
            return self._run_page.command(request)
        return {"id": request.id, "op": request.op, "state": "refused", "reason": "there is no run yet"}
