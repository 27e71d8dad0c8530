"""Requests of operators: sent in threads of their own, and tracked until they have taken effect.

`CommandClient` sends requests and modes, and reports the outcome of each. Orders must not be lost: `OrderBook` resends
each until it is carried out, refused or replaced. The page chooses the id of an order, and repeats the order until it
is settled; the console creates one order per id, and resends an order that has not been confirmed: the answer may be
missing, a radio may have lost the command, or its stamp may have become too old while a process stalled. Other
requests are sent once; `PendingRequests` reports when an accepted one is done.
"""

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple
from uuid import uuid4

from msgspec import Meta, Struct

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import EstimateView, ViewCluster, ViewDrones, ViewEstimates
from zsim.contract.run_messages import Event
from zsim.errors import ZsimError
from zsim.transport.session import Session, Unanswered
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_bridges.console.view_buffer import ViewBuffer, arguments_text, commanded_drone

PRIORITY = 10  # priority of operators in the contract
PRIORITY_EMERGENCY = 100  # highest in the contract: an operator who flies a drone must not keep others from stopping it
THREADS_PER_POOL = 8  # pools are separate, since unanswered requests must not delay modes
ANSWER_TIMEOUT_S = 5.0  # the world and controllers normally answer within a gate
EMERGENCY_TIMEOUT_S = 1.0  # for acquiring a drone that is to be stopped; then the mode is sent even without an answer
ACCEPTANCE_TIMEOUT_S = 1.0  # for the world to accept a command, after which the drone is released
SUPERSEDED = "superseded by a later emergency"
Task = Callable[[], None]
REPEAT_S = 1.0  # wall; an order without an effect for this long is sent again: the world answers within a gate
ORDERS_KEPT = 200  # number of settled orders that are remembered: three minutes at one click a second
SHOWN_S = 20.0  # wall; how long pages show a settled order
NAME_MAX = 64  # maximum number of characters of an id or a name
REASONS_MAX = 2  # maximum number of an order's targets for which reasons are shown
STALE_STAMP = "age is "  # start of the world's refusal of a stamp that is too old; the command is then stamped anew
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
REACHED_M, REACHED_RAD = 0.2, 0.05  # error below which a target is reached; design choice: the accuracy in the paper
Name = Annotated[str, Meta(max_length=NAME_MAX)]


class RequestOutcome(NamedTuple):
    """The outcome of a request: its description, and why it was refused (empty if it was accepted)."""

    request: str
    refusal: str
    subject: str = ""  # the formation or drone; empty for the run
    op: str = ""
    args: Mapping[str, Any] = {}
    order: str = ""  # id of the order that it attempts to carry out; empty for none
    unanswered: bool = False  # whether there was no answer, so that it may still be carried out


class NoAnswer(str):
    """The text of a refusal that only means that there was no answer."""

    __slots__ = ()


class PastInstant(NamedTuple):
    """The recorded views of one gate; estimates by drone, formations by name."""

    drones: ViewDrones
    clusters: dict[str, ViewCluster]
    estimates: dict[str, EstimateView]


class CommandClient:
    """Sends requests in the console's name.

    Args:
        views: counts the commands that have been answered.
        now_ns: returns the simulated time for a stamp; it may poll the world.
        report: called with the outcome of each request, in any thread.
    """

    def __init__(
        self,
        link: Session,
        name: str,
        views: ViewBuffer,
        now_ns: Callable[[], int],
        report: Callable[[RequestOutcome], None],
    ) -> None:
        self._link = link
        self._name = name
        self._views = views
        self._now_ns = now_ns
        self._report = report
        self._seqs: Counter[str] = Counter()  # number of messages sent on each key
        self._modes: Counter[str] = Counter()  # number of modes requested of each drone
        self._emergencies: Counter[str] = Counter()  # how many of them are emergencies
        self.cluster_requests: Counter[str] = Counter()  # number of requests so far, by formation
        self._lock = threading.RLock()
        self._pools = [
            ThreadPoolExecutor(THREADS_PER_POOL, thread_name_prefix=f"console-{kind}")
            for kind in ("request", "mode", "emergency", "release")
        ]
        self._requests, mode_pool, emergency_pool, self._releases = self._pools
        self._queue = DroneQueue(mode_pool, emergency_pool)

    def close(self) -> None:
        self._queue.close()
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)

    def request_world(self, op: str, **args: Any) -> None:
        outcome = RequestOutcome(f"{op} {arguments_text(args)}".strip(), "")
        self._submit(self._requests.submit, outcome, self._request, keys.CONTROL, op, args)

    def seek(self, t_s: float, step: bool) -> None:
        """Move a replay to a simulated time; with `step`, also play one gate there, so that a paused one shows it."""

        def act() -> str:
            refusal = self._request(keys.CONTROL, "seek", {"t_s": t_s})
            return refusal or (self._request(keys.CONTROL, "step", {"gates": 1}) if step else "")

        self._submit(self._requests.submit, RequestOutcome(f"seek {t_s:g} s", ""), act)

    def timeline(self) -> dict[str, Any]:
        """Return the timeline of a replay; empty if there is no answer."""
        with suppress(ZsimError):
            answer = self._link.request(keys.CONTROL, "timeline", self._name, {}, ANSWER_TIMEOUT_S)
            if answer.ok and isinstance(answer.result, dict) and "to_s" in answer.result:
                return answer.result
        return {}

    def read(self, act: Task) -> bool:
        """Run a task that reads data, in another thread; return whether it was scheduled."""
        try:
            self._requests.submit(act)
        except RuntimeError:  # closed
            return False
        return True

    def past_views(self, from_s: float, to_s: float, every_s: float) -> list[PastInstant]:
        """Return the views in a replay's record, of one gate every `every_s`; empty if there is no answer."""
        args = {"from_s": from_s, "to_s": to_s, "every_s": every_s}
        instants: dict[int, PastInstant] = {}
        with suppress(ZsimError, LookupError, TypeError, ValueError):
            answer = self._link.request(keys.CONTROL, "views", self._name, args, ANSWER_TIMEOUT_S)
            for key, payload in answer.result if answer.ok else ():
                view = messages.decode(key, payload)
                if isinstance(view, ViewDrones):
                    instants[view.t_ns] = PastInstant(view, {}, {})
                elif isinstance(view, ViewCluster):
                    instants[view.t_ns].clusters[key.rpartition("/")[2]] = view
                elif isinstance(view, ViewEstimates):
                    instants[view.t_ns].estimates.update({each.name: each for each in view.estimates})
        return list(instants.values())

    def request_cluster(self, cluster: str, op: str, args_text: str = "", order: str = "", **args: Any) -> None:
        """Request an operation of a formation's controller; `args_text` describes its arguments on the page."""
        self.cluster_requests[cluster] += 1
        text = f"{cluster}: {op} {args_text or arguments_text(args)}".strip()
        outcome = RequestOutcome(text, "", cluster, op, args, order)
        self._submit(self._requests.submit, outcome, self._request, keys.cluster_control(cluster), op, args)

    def send_mode(self, drones: Sequence[str], mode: str, order: str = "") -> None:
        """Make drones take off, land, stop at once or leave the emergency state, with an operator's priority.

        An emergency has the highest priority, and is sent even if the drone cannot be acquired.

        Modes of one drone are sent in the order in which they were requested, except for an emergency: it does not wait
        for earlier ones, and these are not sent after it.
        """
        for drone in drones:
            self._modes[drone] += 1
            outcome = RequestOutcome(f"{drone}: {mode}", "", drone, mode, order=order)
            if mode == "emergency":
                with self._lock:
                    self._emergencies[drone] += 1
                self._submit(partial(self._queue.submit_urgent, drone), outcome, self._send_emergency, drone, mode)
            else:
                submit, emergencies = partial(self._queue.submit, drone), self._emergencies[drone]
                self._submit(submit, outcome, self._acquire_and_send, drone, mode, emergencies)

    def modes_requested(self, drone: str) -> int:
        return self._modes[drone]

    def take(self, drone: str, on_done: Callable[[str], None]) -> None:
        """Acquire a drone with an operator's priority; `on_done` receives why it was refused, empty if it was not."""
        with suppress(RuntimeError):  # closed; the run has ended
            self._requests.submit(lambda: on_done(_refusal_of(self._acquire, drone, PRIORITY)))

    def release_drone(self, drone: str) -> None:
        """Release a drone, which then hovers until another process flies it."""
        with suppress(RuntimeError):
            self._releases.submit(_refusal_of, self._request, keys.CONTROL, "release", {"drone": drone})

    def send_velocity(self, drone: str, velocity_m_s: tuple[float, float, float], yaw_rate_rad_s: float) -> None:
        """Send an acquired drone a velocity command in its heading frame."""
        key, v = keys.command(drone, "velocity"), velocity_m_s
        with suppress(ZsimError):  # the link is lost: the world lets the drone hover
            message = flight_messages.Velocity(self._now_ns(), self._next_seq(key), self._name, v, yaw_rate_rad_s)
            self._link.put(key, message)

    def _next_seq(self, key: str) -> int:
        with self._lock:
            seq, self._seqs[key] = self._seqs[key], self._seqs[key] + 1
        return seq

    def _submit(
        self, submit: Callable[[Callable[[], None]], Any], outcome: RequestOutcome, act: Callable[..., str], *args: Any
    ) -> None:
        def done() -> None:
            refusal = _refusal_of(act, *args)
            self._report(outcome._replace(refusal=str(refusal), unanswered=isinstance(refusal, NoAnswer)))

        try:
            submit(done)
        except RuntimeError:  # closed; a page of the run may still be open
            self._report(outcome._replace(refusal="the run has ended"))

    def _request(self, key: str, op: str, args: dict[str, Any], timeout_s: float = ANSWER_TIMEOUT_S) -> str:
        answer = self._link.request(key, op, self._name, args, timeout_s)
        refusal = "" if answer.ok else answer.error or "refused without a reason"
        return NoAnswer(refusal) if isinstance(answer, Unanswered) else refusal

    def _acquire_and_send(self, drone: str, mode: str, emergencies: int) -> str:
        """Acquire a drone and send the mode, unless more than `emergencies` have been requested meanwhile."""
        if self._emergencies[drone] > emergencies:
            return SUPERSEDED
        return self._acquire(drone, PRIORITY) or self._send(drone, mode, emergencies)

    def _send_emergency(self, drone: str, mode: str) -> str:
        """Send the mode even if the drone could not be acquired: the world may accept it anyway."""
        refusal = _refusal_of(self._acquire, drone, PRIORITY_EMERGENCY, EMERGENCY_TIMEOUT_S)
        self._send(drone, mode)
        report = refusal and f"{refusal}; {mode} was sent anyway"
        return NoAnswer(report) if isinstance(refusal, NoAnswer) else report

    def _acquire(self, drone: str, priority: int, timeout_s: float = ANSWER_TIMEOUT_S) -> str:
        return self._request(keys.CONTROL, "acquire", {"drone": drone, "priority": priority}, timeout_s)

    def _send(self, drone: str, mode: str, emergencies: int | None = None) -> str:
        """Send a mode, unless more than `emergencies` have been requested; release the drone afterwards."""
        answered_before, now_ns = self._views.answered_commands(drone), self._now_ns()
        with self._lock:
            is_superseded = emergencies is not None and self._emergencies[drone] > emergencies
            if not is_superseded:
                key = keys.command(drone, "mode")
                message = flight_messages.Mode(now_ns, self._next_seq(key), self._name, mode)  # type: ignore[arg-type]
                self._link.put(key, message)
        with suppress(RuntimeError):  # closed: leaving a run releases all drones
            self._releases.submit(self._release, drone, answered_before)
        return SUPERSEDED if is_superseded else ""

    def _release(self, drone: str, answered_before: int) -> None:
        """Release a drone once the world has answered the mode, or after ACCEPTANCE_TIMEOUT_S without an answer."""
        self._views.await_answer(drone, answered_before, ACCEPTANCE_TIMEOUT_S)
        with suppress(ZsimError):  # the run has ended
            self._request(keys.CONTROL, "release", {"drone": drone})


def _refusal_of(act: Callable[..., str], *args: Any) -> str:
    try:
        return act(*args)
    except ZsimError as error:
        return str(error)
    except Exception as error:  # a pool would swallow the exception
        return f"{type(error).__name__}: {error}"


@dataclass
class _DroneTasks:
    running_count: int = 0  # number of running tasks
    waiting: deque[Task] = field(default_factory=deque)


class DroneQueue:
    """Runs the tasks of each drone in order of submission in `pool`, and urgent ones at once in `urgent`.

    Tasks of different drones do not wait for each other. Once the queue is closed, submitting raises RuntimeError.
    """

    def __init__(self, pool: Executor, urgent: Executor) -> None:
        self._pool = pool
        self._urgent = urgent
        self._tasks: dict[str, _DroneTasks] = {}
        self._lock = threading.Lock()
        self._closed = False

    def close(self) -> None:
        with self._lock:
            self._closed = True
            self._tasks.clear()

    def submit(self, name: str, act: Task) -> None:
        """Run a task after all earlier ones of that name."""
        with self._lock:
            tasks = self._tasks.get(name)
            if tasks is not None and tasks.running_count:
                tasks.waiting.append(act)
            else:
                self._start(self._pool, name, act)

    def submit_urgent(self, name: str, act: Task) -> None:
        """Run a task without waiting for earlier ones; later ones wait for it."""
        with self._lock:
            self._start(self._urgent, name, act)

    def _start(self, pool: Executor, name: str, act: Task) -> None:
        def run() -> None:
            try:
                act()
            finally:
                self._end(name)

        if self._closed:
            raise RuntimeError("closed")
        pool.submit(run)
        self._tasks.setdefault(name, _DroneTasks()).running_count += 1

    def _end(self, name: str) -> None:
        with self._lock:
            tasks = self._tasks.get(name)
            if tasks is None:
                return  # closed
            tasks.running_count -= 1
            if tasks.running_count:
                return
            if tasks.waiting:
                self._start(self._pool, name, tasks.waiting.popleft())
            else:
                del self._tasks[name]


class OrderRequest(Struct, frozen=True, forbid_unknown_fields=True):
    """An order from a page, which repeats it with the same id until it is settled."""

    op: Literal["emergency", "land", "hold", "acknowledge"]
    id: Name = ""
    """Chosen by the page; an order is carried out once per id. Empty: the order will not be repeated."""
    run: Name = ""
    """The run for which the order was given, which any other run refuses. Empty: the run that is shown."""
    drone: Name = ""
    cluster: Name = ""
    """The target is `drone` or `cluster`; if both are empty, all to which the operation applies."""


@dataclass
class _Target:
    """A drone or formation that an order concerns."""

    is_drone: bool
    state: OrderState = "sent"
    reason: str = ""  # why the order is refused, or not yet confirmed
    is_in_progress: bool = False  # whether an attempt is in progress
    attempts: int = 0
    sent_s: float = 0.0  # when the last attempt began [s; wall]
    modes: int = 0  # number of modes requested of a drone, including this order's; a further one replaces the order
    accepted: bool = False  # whether the world has accepted the last command


@dataclass
class _Order:
    id: str
    op: Any
    subject: str
    targets: dict[str, _Target]  # by name
    given_s: float  # when the order was given [s; wall]
    given_ns: int  # when the order was given [simulated]
    settled_s: float | None = None  # when the order was settled [s; wall]
    confirmed_ns: int | None = None
    refusal: str = ""
    notified: set[str] = field(default_factory=set)  # targets with outcomes that operators were notified of

    @property
    def state(self) -> OrderState:
        if self.refusal:
            return "refused"
        states: list[OrderState] = [target.state for target in self.targets.values()]
        return min(states, key=_WORST_FIRST.index)


class OrderBook:
    """Carries out the orders of one run; thread-safe.

    Args:
        members: the drones of each formation.
        refusal: returns why nothing can be flown, empty if something can; a silent world does not count.
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
        """Carry out an order, unless one with its id was placed before; return the order's progress as plain data."""
        order_id = request.id or uuid4().hex
        with self._lock:
            order = self._orders.get(order_id)
            if order is None:
                order = self._orders[order_id] = self._create_order(order_id, request)
                for settled in [key for key, each in self._orders.items() if each.settled_s is not None][:-ORDERS_KEPT]:
                    del self._orders[settled]
                if not order.refusal:
                    self._replace_earlier(order)
                    for name in order.targets:
                        self._send(order, name)
            return self._row(order)

    def note(self, outcome: RequestOutcome) -> bool:
        """Process the outcome of an attempt; return whether to notify operators, once per target."""
        with self._lock:
            order = self._orders.get(outcome.order)
            target = order.targets.get(outcome.subject) if order else None
            if order is None or target is None:
                return True
            target.is_in_progress = False
            if target.state != "sent":
                return False
            target.reason = outcome.refusal
            if outcome.unanswered:
                return False
            if not target.is_drone:
                self._settle(order, target, "refused" if outcome.refusal else "confirmed", outcome.refusal)
            elif outcome.refusal and order.op != "emergency":  # an emergency is sent regardless
                self._settle(order, target, "refused", outcome.refusal)
            is_new = outcome.subject not in order.notified
            order.notified.add(outcome.subject)
            return is_new

    def on_event(self, event: Event) -> None:
        subject = commanded_drone(event)
        with self._lock:
            for order in self._open_orders():
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
        """Settle orders that have taken effect, were replaced or can no longer be carried out; repeat the others.

        `states` has the states of drones and the phases of formations at `t_ns`. A command that is accepted while the
        run is paused takes effect when the run resumes, and is not repeated before.
        """
        with self._lock:
            self._paused = paused
            ended, silent, wall_s = self._refusal(), self._silent_s() > 0.0, self._wall_s()
            for order in self._open_orders():
                for name, target in order.targets.items():
                    if target.state != "sent":
                        continue
                    # A formation's controller answers requests: its phase matters only after one went unanswered.
                    has_effect = states.get(name) in _CARRIED_OUT[order.op] and (target.is_drone or target.attempts > 1)
                    must_wait = target.is_in_progress or silent or (paused and target.accepted)
                    if ended:
                        self._settle(order, target, "refused", ended)
                    elif t_ns > order.given_ns and has_effect:
                        self._settle(order, target, "confirmed", t_ns=t_ns)
                    elif target.is_drone and self._client.modes_requested(name) > target.modes:
                        self._settle(order, target, "replaced")
                    elif not must_wait and wall_s - target.sent_s >= REPEAT_S:
                        self._send(order, name)

    def rows(self) -> list[dict[str, Any]]:
        """Return the orders that pages show, as plain data, the newest first."""
        wall_s = self._wall_s()
        with self._lock:
            shown = [o for o in self._orders.values() if o.settled_s is None or wall_s - o.settled_s < SHOWN_S]
            return [self._row(order) for order in reversed(shown)]

    def _open_orders(self) -> list[_Order]:
        return [order for order in self._orders.values() if order.settled_s is None]

    def _create_order(self, order_id: str, request: OrderRequest) -> _Order:
        subject = request.drone or request.cluster
        if subject:
            target_names = [subject]
        elif request.op == "emergency":
            target_names = list(self._drones)
        else:
            in_formations = {name for drones in self._members.values() for name in drones}
            single = [] if request.op == "hold" else [name for name in self._drones if name not in in_formations]
            target_names = [*self._members, *single]
        targets = {name: _Target(is_drone=name in self._drones) for name in target_names}
        order = _Order(order_id, request.op, subject, targets, self._wall_s(), self._now_ns())
        order.refusal = self._refusal()
        if request.run and request.run != self._run_id:
            order.refusal = "it was given for another run"
        elif subject and subject not in (*self._drones, *self._members):
            order.refusal = f"{subject!r} is not a drone or formation of the run"
        elif not targets:
            order.refusal = f"no drone or formation to {request.op}"
        if order.refusal:
            order.settled_s = order.given_s
        return order

    def _replace_earlier(self, order: _Order) -> None:
        """Replace earlier orders for the same targets; an emergency is replaced only by another emergency.

        An emergency also replaces the orders for formations all of whose drones it stops.
        """
        target_names = set(order.targets)
        if order.op == "emergency":
            target_names |= {name for name, drones in self._members.items() if target_names.issuperset(drones)}
        for earlier in self._open_orders():
            if earlier is order or (earlier.op == "emergency" and order.op != "emergency"):
                continue
            for name in target_names & set(earlier.targets):
                if earlier.targets[name].state == "sent":
                    self._settle(earlier, earlier.targets[name], "replaced")

    def _send(self, order: _Order, name: str) -> None:
        target = order.targets[name]
        target.is_in_progress, target.sent_s, target.accepted = True, self._wall_s(), False
        target.attempts += 1
        if target.is_drone:
            self._client.send_mode([name], order.op, order=order.id)
            target.modes = self._client.modes_requested(name)
        else:
            self._client.request_cluster(name, order.op, order=order.id)

    def _settle(self, order: _Order, target: _Target, state: OrderState, reason: str = "", t_ns: int = 0) -> None:
        target.state, target.reason = state, reason
        if all(each.state != "sent" for each in order.targets.values()):
            order.settled_s, order.confirmed_ns = self._wall_s(), t_ns or self._now_ns()

    def _row(self, order: _Order) -> dict[str, Any]:
        targets = {name: target for name, target in order.targets.items() if target.state == order.state}
        reasons = [f"{name}: {target.reason}" for name, target in targets.items() if target.reason]
        omitted = [f"{len(reasons) - REASONS_MAX} more"] if len(reasons) > REASONS_MAX else []
        reason, silent_s, wall_s = "; ".join([*reasons[:REASONS_MAX], *omitted]), self._silent_s(), self._wall_s()
        if order.state == "sent" and silent_s:
            reason = f"the world has not answered for {silent_s:.0f} s"
        elif order.state == "sent" and self._paused and all(target.accepted for target in targets.values()):
            reason = "accepted by the world, which is paused"
        return {
            "id": order.id,
            "op": order.op,
            "subject": order.subject,
            "state": order.state,
            "age_s": wall_s - order.given_s,
            "over_s": None if order.settled_s is None else wall_s - order.settled_s,
            "t_s": None if order.confirmed_ns is None else order.confirmed_ns / 1e9,
            "waiting": list(targets) if order.state == "sent" else [],
            "reason": order.refusal or reason,
        }


class PendingRequest(NamedTuple):
    """An accepted request to a formation or drone; `text` describes it."""

    subject: str
    op: str
    text: str
    values: Mapping[str, float] = {}


class PendingRequests:
    """Keeps the last accepted request to each drone and formation until it is done or replaced."""

    def __init__(self) -> None:
        self._pending: dict[str, PendingRequest] = {}

    def accept(self, subject: str, op: str, text: str, args: Mapping[str, Any]) -> bool:
        """Keep a request if its completion can be observed; return whether it can."""
        is_observable = op in PHASES_DONE or op in STATES_DONE or (op == "target" and bool(args.get("values")))
        if is_observable:
            self._pending[subject] = PendingRequest(subject, op, text, args.get("values", {}))
        return is_observable

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
    values = dict(zip(view.names, view.value, strict=True))
    for name, value in request.values.items():
        error = values.get(name, math.inf) - value
        if unit(name) == "rad" and math.isfinite(error):
            is_reached = abs(math.remainder(error, math.tau)) < REACHED_RAD
        else:
            is_reached = abs(error) < REACHED_M
        if not is_reached:
            return False
    return True
