"""Orders of operators that must not get lost: each is sent until the world has carried it out or refused it.

An order has an id of the page that gave it. A page repeats an order that it has no answer to; the console carries out
each id once, and repeats towards the world what the world has not confirmed: after an answer that did not come, a radio
that lost the command, a stamp that grew old while a process stood still.
"""

import math
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple
from uuid import uuid4

from msgspec import Meta, Struct

from zsim.contract import keys
from zsim.contract.run_messages import Event
from zsim.contract.views import ViewCluster
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_bridges.console.command_client import CommandClient, RequestOutcome

REPEAT_S = 1.0  # wall; without an effect for so long an order is sent to the world again: it answers within a gate
KEPT = 200  # orders whose ids are known: at one click a second those of three minutes
SHOWN_S = 20.0  # wall; for which pages show an order that is over
ID_MAX, NAME_MAX = 64, 64  # characters
REASONS_MAX = 2  # that are named of an order
STALE_STAMP = "age is "  # begins the world's refusal of a command whose stamp is too old: to be stamped anew

OrderState = Literal["sent", "confirmed", "refused", "replaced"]
_CARRIED_OUT = {
    "emergency": frozenset({"emergency"}),
    "land": frozenset({"landing", "landed", "idle"}),
    "hold": frozenset({"held"}),
}
"""States of drones, and phases of formations, that show an order's effect."""
_WORST_FIRST: tuple[OrderState, ...] = ("sent", "refused", "replaced", "confirmed")

Name = Annotated[str, Meta(max_length=NAME_MAX)]


class OrderRequest(Struct, frozen=True, forbid_unknown_fields=True):
    """What a page orders, by a button that must not get lost; to be repeated with its id until it is confirmed."""

    op: Literal["emergency", "land", "hold", "acknowledge"]
    id: Annotated[str, Meta(max_length=ID_MAX)] = ""
    """Of the page's choice; an order is carried out once for each. Empty: the order is not to be repeated."""
    run: Name = ""
    """The run for which it was given; refused in any other one. Empty: whichever is shown."""
    drone: Name = ""
    cluster: Name = ""
    """Whom it concerns; all where both are empty."""


@dataclass
class _Target:
    """A drone or formation that an order concerns.

    Attributes:
        state: see `OrderState`.
        reason: why it is refused, or not confirmed.
        busy: whether an attempt is under way.
        attempts: so many were made.
        sent_s: when the last one began [s; wall].
        modes: requested of a drone, with those of this order; further ones replace it.
        accepted: whether the world has the last command, and is to carry it out.
    """

    is_drone: bool
    state: OrderState = "sent"
    reason: str = ""
    busy: bool = False
    attempts: int = 0
    sent_s: float = 0.0
    modes: int = 0
    accepted: bool = False


@dataclass
class _Order:
    """An order, its targets by name, and when it was given and over [s; wall]."""

    id: str
    op: Any
    subject: str
    targets: dict[str, _Target]
    given_s: float
    since_ns: int
    over_s: float | None = None
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
    """Carries out orders of one run, and follows each until the world has confirmed or refused it.

    Args:
        client: sends to the world.
        run_id: of the run.
        members: drones of each formation.
        drones: names of all.
        refusal: returns why nobody can be flown at all; empty where somebody can. Not a world that is silent.
        now_ns: returns the simulated time of the newest clock.
        silent_s: returns for how long the world has not answered [s; wall].
        external: drones whose modes the world only hands on: what their states show counts.
        wall_s: monotonic.
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
        """Carry out an order, unless one of its id was carried out before; return it as plain data."""
        order_id = request.id or uuid4().hex
        with self._lock:
            order = self._orders.get(order_id)
            if order is None:
                order = self._orders[order_id] = self._new(order_id, request)
                self._forget_old()
                if not order.refusal:
                    self._replace_earlier(order)
                    for name in order.targets:
                        self._send(order, name)
            return self._row(order)

    def note(self, outcome: RequestOutcome) -> bool:
        """Take the outcome of an attempt; return whether operators are to be told of it, each outcome once."""
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
            elif outcome.refusal and order.op != "emergency":  # an emergency is sent even where it is refused the drone
                self._settle(order, target, "refused", outcome.refusal)
            is_new = outcome.subject not in order.told
            order.told.add(outcome.subject)
            return is_new

    def on_event(self, event: Event) -> None:
        """Take an event of the world about a command of this console."""
        with self._lock:
            for order in [each for each in self._orders.values() if each.over_s is None]:
                subject = keys.thing(event.subject) if "/" in event.subject else event.subject
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
        """Look which orders have had their effect, and send again those that have not.

        Args:
            states: of drones, and phases of formations, by name.
            t_ns: simulated, of which they are.
            paused: whether the run stands still: what the world has taken has no effect before it goes on.
        """
        with self._lock:
            self._paused = paused
            ended, silent = self._refusal(), self._silent_s() > 0.0
            for order in [each for each in self._orders.values() if each.over_s is None]:
                for name, target in order.targets.items():
                    if target.state != "sent":
                        continue
                    if ended:
                        self._settle(order, target, "refused", ended)
                    elif t_ns > order.since_ns and self._has_effect(order, name, target, states):
                        self._settle(order, target, "confirmed", t_ns=t_ns)
                    elif target.is_drone and self._client.modes_requested(name) > target.modes:
                        self._settle(order, target, "replaced")
                    elif not (target.busy or silent or (paused and target.accepted)) and self._is_due(target):
                        self._send(order, name)

    def rows(self) -> list[dict[str, Any]]:
        """Return the orders that pages show, as plain data, the newest first."""
        wall_s = self._wall_s()
        with self._lock:
            shown = [o for o in self._orders.values() if o.over_s is None or wall_s - o.over_s < SHOWN_S]
            return [self._row(order) for order in reversed(shown)]

    def _new(self, order_id: str, request: OrderRequest) -> _Order:
        targets = {name: _Target(is_drone=name in self._drones) for name in self._concerned(request)}
        subject = request.drone or request.cluster
        order = _Order(order_id, request.op, subject, targets, self._wall_s(), self._now_ns())
        order.refusal = self._refusal()
        if request.run and request.run != self._run_id:
            order.refusal = "it was given for another run"
        elif subject and subject not in (*self._drones, *self._members):
            order.refusal = f"{subject!r} is none of the run's drones and formations"
        elif not targets:
            order.refusal = f"there is nobody to {request.op}"
        if order.refusal:
            order.over_s = order.given_s
        return order

    def _concerned(self, request: OrderRequest) -> list[str]:
        if request.drone or request.cluster:
            return [request.drone or request.cluster]
        if request.op == "emergency":
            return list(self._drones)
        led = {name for drones in self._members.values() for name in drones}
        single = [] if request.op == "hold" else [name for name in self._drones if name not in led]
        return [*self._members, *single]

    def _replace_earlier(self, order: _Order) -> None:
        """Let earlier orders go that a new one contradicts: an emergency, all of its drones and their formations."""
        concerned = set(order.targets)
        if order.op == "emergency":
            concerned |= {name for name, drones in self._members.items() if concerned.issuperset(drones)}
        for earlier in [each for each in self._orders.values() if each.over_s is None and each is not order]:
            if earlier.op == "emergency" and order.op != "emergency":
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

    def _is_due(self, target: _Target) -> bool:
        return self._wall_s() - target.sent_s >= REPEAT_S

    def _has_effect(self, order: _Order, name: str, target: _Target, states: Mapping[str, str]) -> bool:
        """Return whether a drone or formation shows the effect; a formation's controller answers, so before it has
        left a request without an answer its phase does not count."""
        return states.get(name) in _CARRIED_OUT[order.op] and (target.is_drone or target.attempts > 1)

    def _settle(self, order: _Order, target: _Target, state: OrderState, reason: str = "", t_ns: int = 0) -> None:
        target.state, target.reason = state, reason
        if all(each.state != "sent" for each in order.targets.values()):
            order.over_s, order.confirmed_ns = self._wall_s(), t_ns or self._now_ns()

    def _forget_old(self) -> None:
        for order_id in [key for key, order in self._orders.items() if order.over_s is not None][:-KEPT]:
            del self._orders[order_id]

    def _row(self, order: _Order) -> dict[str, Any]:
        found = {name: target for name, target in order.targets.items() if target.state == order.state}
        reasons = [f"{name}: {target.reason}" for name, target in found.items() if target.reason]
        more = [f"{len(reasons) - REASONS_MAX} more"] if len(reasons) > REASONS_MAX else []
        reason, silent_s, wall_s = "; ".join([*reasons[:REASONS_MAX], *more]), self._silent_s(), self._wall_s()
        if order.state == "sent" and silent_s:
            reason = f"the world has not answered for {silent_s:.0f} s"
        elif order.state == "sent" and self._paused and all(target.accepted for target in found.values()):
            reason = "the world has it, and is paused"
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
