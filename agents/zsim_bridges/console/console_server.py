"""The console: one page after the other's run, behind one door."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import viser

from zsim.contract.messages import Info
from zsim.transport.session import Session
from zsim_bridges.console.forms.controls import PageControls
from zsim_bridges.console.http.http_proxy import HttpProxy, ViserBackend, ListenAddress
from zsim_bridges.console.http.page_rights import OPERATOR, VIEWER
from zsim_bridges.console.http.private_viser import PrivateViser
from zsim_bridges.console.run_page import RunPage
from zsim_bridges.console.scene.camera_follow import CameraFollow
from zsim_bridges.observer_process import ObserverProcess


class Console:
    """One console.

    Args:
        place: where pages are served.
        name: process name.
        token: of operators; None on this machine alone.
        rate_hz: pictures a second; None: as many as suit the number of drones.
        say: told what a person should know.

    Raises:
        RunError: others could reach it, and there is no token.
    """

    def __init__(
        self, place: ListenAddress, name: str, token: str | None, rate_hz: float | None, say: Callable[[str], None]
    ) -> None:
        self._name = name
        self._rate_hz = rate_hz
        self._say = say
        self._show: RunPage | None = None
        self._viser = PrivateViser()
        self._followers = CameraFollow(self._viser.server)
        _show_text(self._viser.server.gui, "waiting for a world")
        controls = PageControls(self._viser.server.gui, self._followers.switches)
        inside = ViserBackend(self._viser.port, self._viser.secret, self._state, controls)
        self._door = HttpProxy(place, token, inside)

    @contextmanager
    def open(self) -> Iterator[None]:
        """Let pages in.

        Raises:
            RunError: the port is taken.
        """
        try:
            with self._door.open():
                links = self._door.urls()
                self._say(f"{self._name}: steer at {links[OPERATOR]}")
                self._say(f"{self._name}: look, without steering, at {links[VIEWER]}")
                yield
        finally:
            self._viser.close()

    def serve(
        self, link: Session, info: Info, presence: ObserverProcess, stopped: Callable[[], bool], say: Callable[[str], None]
    ) -> None:
        """Show a run until it is over, or somebody says stop."""
        self._show = show = RunPage(self._viser.server, link, info, presence, self._followers, self._rate_hz)
        try:
            show.run(stopped)
        finally:
            show.close()

    def _state(self) -> dict[str, Any]:
        return self._show.state() if self._show else {"run_id": None}


def _show_text(gui: viser.GuiApi, text: str) -> None:
    """Put a line on pages that have no run to show."""
    gui.configure_theme(show_logo=False, show_share_button=False)
    gui.set_panel_label("zsim")
    gui.add_markdown(text)
