"""The server of a run's drones, without sockets: what it asks the run for, and what it prints."""

from typing import Any

import pytest
from fake_link import FakeLink

from zsim.contract import keys
from zsim.contract.messages import DroneInfo, Info, Origin
from zsim.errors import install_command
from zsim.runtime.participant import Participant
from zsim_bridges.ardrone import ardrone_server
from zsim_bridges.ardrone.ardrone_server import ArdroneOptions, ArdroneServer

SCENARIO = "{name: one, duration_s: 10, drones: [{name: drone1, position_m: [0, 0, 0]}]}"
DRONES = (DroneInfo("drone1", "ardrone2"),)


@pytest.mark.parametrize("is_installed", [True, False])
def test_pictures_are_asked_for_where_they_can_be_encoded_else_the_extra_is_named_once(
    monkeypatch: pytest.MonkeyPatch, is_installed: bool
):
    monkeypatch.setattr(ardrone_server, "find_spec", lambda _: object() if is_installed else None)
    link: Any = FakeLink()
    origin = Origin(0.0, 0.0, 0.0)
    info = Info(0, 0, 1, "r", "zsim", "lockstep", 1.0, 1, 1, 1, 1, origin, DRONES, (), SCENARIO, "", "", "")
    observer, lines = Participant(link, info, "ardrone.main"), []
    server = ArdroneServer(link, info, observer, lines.append, ArdroneOptions("127.0.0.2", frozenset(), None))
    assert list(server.wanted_pictures()) == []  # nobody is connected
    watcher: Any = object()
    server._drones["drone1"].video.port.writers.add(watcher)
    wanted = [list(server.wanted_pictures()) for _ in range(2)]
    assert wanted == ([[keys.camera("drone1", "front")]] * 2 if is_installed else [[], []])
    assert len(lines) == (0 if is_installed else 1)
    assert all(install_command(["video"]) in line for line in lines)
    assert observer.health.refused == 0


def test_a_reason_is_printed_once_whatever_its_figures_and_all_are_counted():
    """A flood of datagrams has every length; each drone and each program that sends has a line of its own."""
    link: Any = FakeLink()
    origin = Origin(0.0, 0.0, 0.0)
    info = Info(0, 0, 1, "r", "zsim", "lockstep", 1.0, 1, 1, 1, 1, origin, DRONES, (), SCENARIO, "", "", "")
    observer, lines = Participant(link, info, "ardrone.main"), []
    server = ArdroneServer(link, info, observer, lines.append, ArdroneOptions("127.0.0.2", frozenset(), None))
    for size in range(40):
        for drone in ("drone1", "drone2"):
            server.refuse(f"{drone}: a datagram of {size} bytes on the navdata port is not a request for navdata")
    for host in ("10.0.0.7", "10.0.0.8", "fe80::1", "fe80::2"):
        server.refuse(f"{host} sends datagrams and is not a --peer")
    assert len(lines) == 2 + 4
    assert observer.health.refused == 2 * 40 + 4
