"""What the gateway tells its clients of a run, by what its world and its link do."""

from types import SimpleNamespace
from typing import Any

from zsim_bridges.gateway.gateway_server import Gateway, GatewayPorts


class Ear:
    """A client that keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[tuple[str, str]] = []

    def notify_run(self, state: str, run_id: str) -> None:
        self.told.append((state, run_id))


def test_a_world_that_goes_after_the_end_of_its_run_is_not_lost() -> None:
    ear, flight = Ear(), a_flight("first")
    gateway = Gateway(GatewayPorts("127.0.0.1", 0, 0), "gateway.main", None, dial=never, say=print)
    gateway._clients.add(ear)  # type: ignore[arg-type]
    gateway._begin(flight)
    for state in ("lost", "back"):
        gateway._notify_link(state, flight)
    gateway._end(flight)
    gateway._notify_link("lost", flight)
    gateway._begin(a_flight("second"))
    gateway._notify_link("lost", flight)
    gateway.loop.close()
    assert ear.told == [
        ("begun", "first"),
        ("lost", "first"),
        ("back", "first"),
        ("ended", "first"),
        ("begun", "second"),
    ]


def a_flight(run_id: str) -> Any:
    return SimpleNamespace(link=None, bare_link=None, info=SimpleNamespace(run_id=run_id))


def never(_: str) -> Any:
    raise AssertionError("nobody joins here")
