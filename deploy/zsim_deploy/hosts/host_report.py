"""What `zsim doctor` finds of hosts and of the network between them."""

from typing import Any, NamedTuple


class HostReport(NamedTuple):
    """The facts of a host by its own probe, and what asking it showed."""

    facts: dict[str, Any]
    round_trip_s: float
    clock_offset_s: float
    """Its wall clock minus ours, good to half the round trip."""
    remedy: str = "run `zsim push --hosts FILE`"
    """How it gets another zsim."""


class NetworkPath(NamedTuple):
    """How a host reaches the port on which another listens."""

    source: str
    target: str
    port: int
    figures: dict[str, Any]
