"""Requests of operators, tracked until they have taken effect.

Orders must not be lost: each is sent until the world has carried it out or refused it. The page chooses its id, and
repeats it until it is answered; the console carries out each id once, and repeats to the world whatever the world
has not confirmed: after a missing answer, a command lost by a radio, or a stamp that grew old while a process stalled.
Other requests are made once; `PendingRequests` tells when an accepted one is done.
"""

import math
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple
from uuid import uuid4

from msgspec import Meta, Struct

from zsim.contract.flight_messages import ViewCluster
from zsim.contract.run_messages import Event
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_bridges.console.command_client import CommandClient, RequestOutcome
from zsim_bridges.console.view_buffer import commanded_drone

REPEAT_S = 1.0  # wall; an order without an effect for this long is sent again: the world answers within a gate
KEPT = 200  # orders whose ids are remembered: three minutes' worth at one click a second
SHOWN_S = 20.0  # wall; for which pages show a settled order
NAME_MAX = 64  # characters
REASONS_MAX = 2  # number of targets of an order that are named
STALE_STAMP = "age is "  # begins the world's refusal of a command with too old a stamp, which is then stamped anew
OrderState = Literal["sent", "confirmed", "refused", "replaced"]
_CARRIED_OUT = {
    "emergency": frozenset({"emergency"}),
    "land": frozenset({"landing", "landed", "idle"}),
    "hold": frozenset({"held"}),
}
"""The states of drones and phases of formations that show that an order has taken effect."""
_WORST_FIRST: tuple[OrderState, ...] = ("sent", "refused", "replaced", "confirmed")
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
THERE_M, THERE_RAD = 0.2, 0.05  # of a variable from its target; chosen: about the accuracy of the paper's formations

Name = Annotated[str, Meta(max_length=NAME_MAX)]


class OrderRequest(Struct, frozen=True, forbid_unknown_fields=True):
    """An order of a page, to be repeated with its id until it is confirmed."""

    op: Literal["emergency", "land", "hold", "acknowledge"]
    id: Name = ""
    """Chosen by the page; carried out once. Empty: the order will not be repeated."""
    run: Name = ""
    """The run for which it was given; refused in any other. Empty: the run that is shown."""
    drone: Name = ""
    cluster: Name = ""
    """The targets; all where both are empty."""


@dataclass
class _Target:
    """A drone or formation that an order concerns."""

    is_drone: bool
    state: OrderState = "sent"
    reason: str = ""  # why it is refused, or not confirmed
    busy: bool = False  # whether an attempt is in progress
    attempts: int = 0
    sent_s: float = 0.0  # when the last attempt began [s; wall]
    modes: int = 0  # number of modes requested of a drone, including this order's; a later one replaces it
    accepted: bool = False  # whether the world has accepted the last command


@dataclass
class _Order:
    id: str
    op: Any
    subject: str
    targets: dict[str, _Target]  # by name
    given_s: float  # wall
    since_ns: int
    over_s: float | None = None  # when it was settled [s; wall]
    confirmed_ns: int | None = None
    refusal: str = ""
    told: set[str] = field(default_factory=set)

    @property
    def state(self) -> OrderState:
        if self.refusal:
            return "refused"
        states: list[OrderState] = [target.state for target in self.targets.values()]
        return min(states, key=_WORST_FIRST.index)


class OrderBook:
    """Carries out orders of one run; thread-safe.

    Args:
        members: the drones of each formation.
        refusal: returns why nothing can be flown, apart from a silent world; otherwise empty.
        now_ns: returns the simulated time of the newest clock.
        silent_s: returns for how long the world has not answered [s; wall].
        external: drones whose modes the world only forwards, so that only their states show an effect.
    """

    def __init__(
        self,
        client: CommandClient,
        run_id: str,
        members: Mapping[str, Sequence[str]],
        drones: Sequence[str],
        refusal: Callable[[], str],
        now_ns: Callable[[], int],
        silent_s: Callable[[], float],
        external: Collection[str] = (),
        wall_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client = client
        self._run_id = run_id
        self._members = members
        self._drones = drones
        self._refusal = refusal
        self._now_ns = now_ns
        self._silent_s = silent_s
        self._external = external
        self._wall_s = wall_s
        self._paused = False
        self._orders: dict[str, _Order] = {}
        self._lock = threading.RLock()

    def place(self, request: OrderRequest) -> dict[str, Any]:
        """Carry out an order, unless one with its id was already carried out; return it as plain data."""
        order_id = request.id or uuid4().hex
        with self._lock:
            order = self._orders.get(order_id)
            if order is None:
                order = self._orders[order_id] = self._new(order_id, request)
                for settled in [key for key, each in self._orders.items() if each.over_s is not None][:-KEPT]:
                    del self._orders[settled]
                if not order.refusal:
                    self._replace_earlier(order)
                    for name in order.targets:
                        self._send(order, name)
            return self._row(order)

    def note(self, outcome: RequestOutcome) -> bool:
        """Process the outcome of an attempt; return whether to notify operators, once for each target."""
        with self._lock:
            order = self._orders.get(outcome.order)
            target = order.targets.get(outcome.subject) if order else None
            if order is None or target is None:
                return True
            target.busy = False
            if target.state != "sent":
                return False
            target.reason = outcome.refusal
            if outcome.unanswered:
                return False
            if not target.is_drone:
                self._settle(order, target, "refused" if outcome.refusal else "confirmed", outcome.refusal)
            elif outcome.refusal and order.op != "emergency":  # which is sent even if the drone could not be acquired
                self._settle(order, target, "refused", outcome.refusal)
            is_new = outcome.subject not in order.told
            order.told.add(outcome.subject)
            return is_new

    def on_event(self, event: Event) -> None:
        subject = commanded_drone(event)
        with self._lock:
            for order in self._open():
                target = order.targets.get(subject)
                if target is None or not target.is_drone or target.state != "sent":
                    continue
                if event.kind == "mode" and event.data.get("mode") == order.op and subject not in self._external:
                    self._settle(order, target, "confirmed", t_ns=event.t_ns)
                elif event.kind == "command" and event.data.get("message", {}).get("mode") == order.op:
                    target.accepted = True
                elif event.kind == "refused" and event.subject.endswith("/mode"):
                    target.reason = str(event.data.get("reason", event.text))
                    if not target.reason.startswith(STALE_STAMP):
                        self._settle(order, target, "refused", target.reason)

    def update(self, states: Mapping[str, str], t_ns: int, *, paused: bool) -> None:
        """Settle orders that have taken effect, and repeat the others.

        `states` and the phases of formations are those at t_ns. Commands accepted in a paused run take effect later.
        """
        with self._lock:
            self._paused = paused
            ended, silent, wall_s = self._refusal(), self._silent_s() > 0.0, self._wall_s()
            for order in self._open():
                for name, target in order.targets.items():
                    if target.state != "sent":
                        continue
                    # A formation's controller answers: its phase counts only after a request without an answer.
                    has_effect = states.get(name) in _CARRIED_OUT[order.op] and (target.is_drone or target.attempts > 1)
                    waits = target.busy or silent or (paused and target.accepted)
                    if ended:
                        self._settle(order, target, "refused", ended)
                    elif t_ns > order.since_ns and has_effect:
                        self._settle(order, target, "confirmed", t_ns=t_ns)
                    elif target.is_drone and self._client.modes_requested(name) > target.modes:
                        self._settle(order, target, "replaced")
                    elif not waits and wall_s - target.sent_s >= REPEAT_S:
                        self._send(order, name)

    def rows(self) -> list[dict[str, Any]]:
        """Return the orders that pages show, as plain data, the newest first."""
        wall_s = self._wall_s()
        with self._lock:
            shown = [o for o in self._orders.values() if o.over_s is None or wall_s - o.over_s < SHOWN_S]
            return [self._row(order) for order in reversed(shown)]

    def _open(self) -> list[_Order]:
        return [order for order in self._orders.values() if order.over_s is None]

    def _new(self, order_id: str, request: OrderRequest) -> _Order:
        subject = request.drone or request.cluster
        if subject:
            concerned = [subject]
        elif request.op == "emergency":
            concerned = list(self._drones)
        else:
            led = {name for drones in self._members.values() for name in drones}
            single = [] if request.op == "hold" else [name for name in self._drones if name not in led]
            concerned = [*self._members, *single]
        targets = {name: _Target(is_drone=name in self._drones) for name in concerned}
        order = _Order(order_id, request.op, subject, targets, self._wall_s(), self._now_ns())
        order.refusal = self._refusal()
        if request.run and request.run != self._run_id:
            order.refusal = "it was given for another run"
        elif subject and subject not in (*self._drones, *self._members):
            order.refusal = f"{subject!r} is not a drone or formation of the run"
        elif not targets:
            order.refusal = f"no drone or formation to {request.op}"
        if order.refusal:
            order.over_s = order.given_s
        return order

    def _replace_earlier(self, order: _Order) -> None:
        """Settle earlier orders that a new one contradicts; an emergency, all of its drones and their formations."""
        concerned = set(order.targets)
        if order.op == "emergency":
            concerned |= {name for name, drones in self._members.items() if concerned.issuperset(drones)}
        for earlier in self._open():
            if earlier is order or (earlier.op == "emergency" and order.op != "emergency"):
                continue
            for name in concerned & set(earlier.targets):
                if earlier.targets[name].state == "sent":
                    self._settle(earlier, earlier.targets[name], "replaced")

    def _send(self, order: _Order, name: str) -> None:
        target = order.targets[name]
        target.busy, target.sent_s, target.accepted = True, self._wall_s(), False
        target.attempts += 1
        if target.is_drone:
            self._client.send_mode([name], order.op, order=order.id)
            target.modes = self._client.modes_requested(name)
        else:
            self._client.request_cluster(name, order.op, order=order.id)

    def _settle(self, order: _Order, target: _Target, state: OrderState, reason: str = "", t_ns: int = 0) -> None:
        target.state, target.reason = state, reason
        if all(each.state != "sent" for each in order.targets.values()):
            order.over_s, order.confirmed_ns = self._wall_s(), t_ns or self._now_ns()

    def _row(self, order: _Order) -> dict[str, Any]:
        found = {name: target for name, target in order.targets.items() if target.state == order.state}
        reasons = [f"{name}: {target.reason}" for name, target in found.items() if target.reason]
        more = [f"{len(reasons) - REASONS_MAX} more"] if len(reasons) > REASONS_MAX else []
        reason, silent_s, wall_s = "; ".join([*reasons[:REASONS_MAX], *more]), self._silent_s(), self._wall_s()
        if order.state == "sent" and silent_s:
            reason = f"the world has not answered for {silent_s:.0f} s"
        elif order.state == "sent" and self._paused and all(target.accepted for target in found.values()):
            reason = "accepted by the world, which is paused"
        return {
            "id": order.id,
            "op": order.op,
            "subject": order.subject,
            "state": order.state,
            "age_s": wall_s - order.given_s,
            "over_s": None if order.over_s is None else wall_s - order.over_s,
            "t_s": None if order.confirmed_ns is None else order.confirmed_ns / 1e9,
            "waiting": list(found) if order.state == "sent" else [],
            "reason": order.refusal or reason,
        }


class PendingRequest(NamedTuple):
    """A request to a formation or drone, described by its text."""

    subject: str
    op: str
    text: str
    values: Mapping[str, float] = {}


class PendingRequests:
    """Keeps the last accepted request to each drone and formation until it is done or replaced."""

    def __init__(self) -> None:
        self._pending: dict[str, PendingRequest] = {}

    def accept(self, subject: str, op: str, text: str, args: Mapping[str, Any]) -> bool:
        """Keep a request; return whether its end can be observed."""
        known = op in PHASES_DONE or op in STATES_DONE or (op == "target" and bool(args.get("values")))
        if known:
            self._pending[subject] = PendingRequest(subject, op, text, args.get("values", {}))
        return known

    def pop_done(self, clusters: Mapping[str, ViewCluster], drones: Mapping[str, str]) -> list[PendingRequest]:
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
    for name, value in request.values.items():
        away = flown.get(name, math.inf) - value
        if unit(name) == "rad" and math.isfinite(away):
            there = abs(math.remainder(away, math.tau)) < THERE_RAD
        else:
            there = abs(away) < THERE_M
        if not there:
            return False
    return True
