"""Requests that were accepted and are not done yet: a take-off is done in the air, not when it was asked for. Pure."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from zsim.contract.flight_messages import ViewCluster
from zsim_agents.formation.spaces.cluster_space import unit

PHASES_DONE = {
    "takeoff": frozenset({"assembling", "engaged"}),
    "engage": frozenset({"engaged"}),
    "hold": frozenset({"held"}),
    "rejoin": frozenset({"engaged"}),
    "land": frozenset({"idle"}),
}
STATES_DONE = {
    "takeoff": frozenset({"hovering", "flying"}),
    "land": frozenset({"landed"}),
    "emergency": frozenset({"emergency"}),
    "reset": frozenset({"landed"}),
}
THERE_M, THERE_RAD = 0.2, 0.05  # of a variable at its target; chosen: about what the paper's formations keep to


class PendingRequest(NamedTuple):
    """A request: of a formation or a drone, in words."""

    subject: str
    op: str
    text: str
    values: Mapping[str, float] = {}


class PendingRequests:
    """Keeps the last accepted request of each drone and formation, until it is done or another one replaces it."""

    def __init__(self) -> None:
        self._pending: dict[str, PendingRequest] = {}

    def accept(self, subject: str, op: str, text: str, args: Mapping[str, Any]) -> bool:
        """Keep a request; return whether it is one whose end can be seen."""
        known = op in PHASES_DONE or op in STATES_DONE or (op == "target" and bool(args.get("values")))
        if known:
            self._pending[subject] = PendingRequest(subject, op, text, args.get("values", {}))
        return known

    def pop_done(self, clusters: Mapping[str, ViewCluster], drones: Mapping[str, str]) -> list[PendingRequest]:
        """Return the requests that are done now, each once."""
        done = [each for each in list(self._pending.values()) if _is_done(each, clusters, drones)]
        for each in done:
            self._pending.pop(each.subject, None)
        return done


def _is_done(request: PendingRequest, clusters: Mapping[str, ViewCluster], drones: Mapping[str, str]) -> bool:
    view = clusters.get(request.subject)
    if view is None:
        return drones.get(request.subject) in STATES_DONE.get(request.op, ())
    if request.op != "target":
        return view.phase in PHASES_DONE[request.op]
    flown = dict(zip(view.names, view.value, strict=True))
    return all(name in flown and _is_there(name, flown[name] - value) for name, value in request.values.items())


def _is_there(name: str, away: float) -> bool:
    if unit(name) == "rad":
        return abs(math.remainder(away, math.tau)) < THERE_RAD
    return abs(away) < THERE_M
