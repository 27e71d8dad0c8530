"""An operator's requests and modes, sent outside the page's threads; the outcome of each is reported."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import EstimateView, ViewCluster, ViewDrones, ViewEstimates
from zsim.errors import ZsimError
from zsim.transport.session import Session, Unanswered
from zsim_bridges.console.view_buffer import ViewBuffer, arguments_text

PRIORITY = 10  # contract: of operators
PRIORITY_EMERGENCY = 100  # contract: the highest; an operator who flies a drone must not keep others from stopping it
THREADS_PER_POOL = 8  # separate pools: unanswered requests must not delay modes
ANSWER_TIMEOUT_S = 5.0  # the world and controllers answer within a gate
EMERGENCY_TIMEOUT_S = 1.0  # for acquiring a drone to stop it; afterwards the mode is sent anyway
ACCEPTANCE_TIMEOUT_S = 1.0  # for the world to accept a command before the drone is released
OVERTAKEN = "superseded by a later emergency"
Task = Callable[[], None]


class RequestOutcome(NamedTuple):
    """A request as described, and why it was refused; empty if accepted."""

    request: str
    refusal: str
    subject: str = ""  # the formation or drone; empty for the run
    op: str = ""
    args: Mapping[str, Any] = {}
    order: str = ""  # id of the order that it attempts to carry out; empty for none
    unanswered: bool = False  # whether it may still be carried out, since there was no answer


class NoAnswer(str):
    """A refusal because there was no answer."""

    __slots__ = ()


class PastInstant(NamedTuple):
    """The views of one instant on record; estimates by drone, formations by name."""

    drones: ViewDrones
    clusters: dict[str, ViewCluster]
    estimates: dict[str, EstimateView]


class CommandClient:
    """Sends requests in the console's name.

    `views` tells which commands have been answered, `now_ns` gives the time of a stamp and may poll the world, and
    `report` is called with the outcome of each request, in any thread.
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
        self._seqs: Counter[str] = Counter()  # messages sent on each key
        self._modes: Counter[str] = Counter()  # modes requested of each drone
        self._emergencies: Counter[str] = Counter()  # those of them that are emergencies
        self.cluster_requests: Counter[str] = Counter()  # made so far, by formation
        self._lock = threading.RLock()
        self._pools = [
            ThreadPoolExecutor(THREADS_PER_POOL, thread_name_prefix=f"console-{kind}")
            for kind in ("request", "mode", "emergency", "release")
        ]
        self._requests, modes, stops, self._releases = self._pools
        self._queue = DroneQueue(modes, stops)

    def close(self) -> None:
        self._queue.close()
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)

    def request_world(self, op: str, **args: Any) -> None:
        what = RequestOutcome(f"{op} {arguments_text(args)}".strip(), "")
        self._submit(self._requests.submit, what, self._request, keys.CONTROL, op, args)

    def seek(self, t_s: float, step: bool) -> None:
        """Let a replay continue from an instant; `step`: play one gate there, if it is paused."""

        def act() -> str:
            refusal = self._request(keys.CONTROL, "seek", {"t_s": t_s})
            return refusal or (self._request(keys.CONTROL, "step", {"gates": 1}) if step else "")

        self._submit(self._requests.submit, RequestOutcome(f"seek {t_s:g} s", ""), act)

    def timeline(self) -> dict[str, Any]:
        """Return the timeline of a replay, empty without an answer."""
        with suppress(ZsimError):
            answer = self._link.request(keys.CONTROL, "timeline", self._name, {}, ANSWER_TIMEOUT_S)
            if answer.ok and isinstance(answer.result, dict) and "to_s" in answer.result:
                return answer.result
        return {}

    def read(self, act: Task) -> bool:
        """Run a reading task in another thread; return whether it was scheduled."""
        try:
            self._requests.submit(act)
        except RuntimeError:  # closed
            return False
        return True

    def past_views(self, from_s: float, to_s: float, every_s: float) -> list[PastInstant]:
        """Return views of a replay's record; empty without an answer."""
        args = {"from_s": from_s, "to_s": to_s, "every_s": every_s}
        found: dict[int, PastInstant] = {}
        with suppress(ZsimError, LookupError, TypeError, ValueError):
            answer = self._link.request(keys.CONTROL, "views", self._name, args, ANSWER_TIMEOUT_S)
            for key, payload in answer.result if answer.ok else ():
                view = messages.decode(key, payload)
                if isinstance(view, ViewDrones):
                    found[view.t_ns] = PastInstant(view, {}, {})
                elif isinstance(view, ViewCluster):
                    found[view.t_ns].clusters[key.rpartition("/")[2]] = view
                elif isinstance(view, ViewEstimates):
                    found[view.t_ns].estimates.update({each.name: each for each in view.estimates})
        return list(found.values())

    def request_cluster(self, cluster: str, op: str, shown: str = "", order: str = "", **args: Any) -> None:
        """Request an operation of a formation's controller; `shown` describes the arguments as the page shows them."""
        self.cluster_requests[cluster] += 1
        text = f"{cluster}: {op} {shown or arguments_text(args)}".strip()
        what = RequestOutcome(text, "", cluster, op, args, order)
        self._submit(self._requests.submit, what, self._request, keys.cluster_control(cluster), op, args)

    def send_mode(self, drones: Sequence[str], mode: str, order: str = "") -> None:
        """Let drones take off, land, stop at once or leave the emergency, regardless of their commander.

        Modes of one drone are sent in the order of the requests, except for an emergency: it does not wait for them,
        and no earlier request is sent after it.
        """
        for drone in drones:
            self._modes[drone] += 1
            what = RequestOutcome(f"{drone}: {mode}", "", drone, mode, order=order)
            if mode == "emergency":
                with self._lock:
                    self._emergencies[drone] += 1
                self._submit(partial(self._queue.submit_urgent, drone), what, self._send_emergency, drone, mode)
            else:
                turn, stops = partial(self._queue.submit, drone), self._emergencies[drone]
                self._submit(turn, what, self._acquire_and_send, drone, mode, stops)

    def modes_requested(self, drone: str) -> int:
        return self._modes[drone]

    def take(self, drone: str, done: Callable[[str], None]) -> None:
        """Acquire a drone with an operator's priority; `done` receives the reason for a refusal, else an empty text."""
        with suppress(RuntimeError):  # closed; the run has ended
            self._requests.submit(lambda: done(_refusal_of(self._acquire, drone, PRIORITY)))

    def give_back(self, drone: str) -> None:
        """Release a drone: it hovers until another process flies it."""
        with suppress(RuntimeError):
            self._releases.submit(_refusal_of, self._request, keys.CONTROL, "release", {"drone": drone})

    def send_velocity(self, drone: str, velocity_m_s: tuple[float, float, float], yaw_rate_rad_s: float) -> None:
        """Command a velocity to an acquired drone, in its heading frame."""
        key, v = keys.command(drone, "velocity"), velocity_m_s
        with suppress(ZsimError):  # the link is lost: the world lets the drone hover
            message = flight_messages.Velocity(self._now_ns(), self._next_seq(key), self._name, v, yaw_rate_rad_s)
            self._link.put(key, message)

    def _next_seq(self, key: str) -> int:
        with self._lock:
            seq, self._seqs[key] = self._seqs[key], self._seqs[key] + 1
        return seq

    def _submit(
        self, begin: Callable[[Callable[[], None]], Any], what: RequestOutcome, act: Callable[..., str], *args: Any
    ) -> None:
        def done() -> None:
            refusal = _refusal_of(act, *args)
            self._report(what._replace(refusal=str(refusal), unanswered=isinstance(refusal, NoAnswer)))

        try:
            begin(done)
        except RuntimeError:  # closed; a page of the run may still be open
            self._report(what._replace(refusal="the run has ended"))

    def _request(self, key: str, op: str, args: dict[str, Any], timeout_s: float = ANSWER_TIMEOUT_S) -> str:
        answer = self._link.request(key, op, self._name, args, timeout_s)
        refusal = "" if answer.ok else answer.error or "refused without a reason"
        return NoAnswer(refusal) if isinstance(answer, Unanswered) else refusal

    def _acquire_and_send(self, drone: str, mode: str, stops: int) -> str:
        """Acquire a drone and send the mode, unless more emergencies than `stops` were requested meanwhile."""
        if self._emergencies[drone] > stops:
            return OVERTAKEN
        return self._acquire(drone, PRIORITY) or self._send(drone, mode, stops)

    def _send_emergency(self, drone: str, mode: str) -> str:
        """Send the mode even if the drone could not be acquired: the world may accept it anyway."""
        refusal = _refusal_of(self._acquire, drone, PRIORITY_EMERGENCY, EMERGENCY_TIMEOUT_S)
        self._send(drone, mode)
        told = refusal and f"{refusal}; {mode} was sent anyway"
        return NoAnswer(told) if isinstance(refusal, NoAnswer) else told

    def _acquire(self, drone: str, priority: int, timeout_s: float = ANSWER_TIMEOUT_S) -> str:
        return self._request(keys.CONTROL, "acquire", {"drone": drone, "priority": priority}, timeout_s)

    def _send(self, drone: str, mode: str, stops: int | None = None) -> str:
        """Send a mode, unless more emergencies than `stops` were requested; release the drone afterwards."""
        before, now_ns = self._views.answered_commands(drone), self._now_ns()
        with self._lock:
            overtaken = stops is not None and self._emergencies[drone] > stops
            if not overtaken:
                key = keys.command(drone, "mode")
                message = flight_messages.Mode(now_ns, self._next_seq(key), self._name, mode)  # type: ignore[arg-type]
                self._link.put(key, message)
        with suppress(RuntimeError):  # closed: leaving a run releases all drones
            self._releases.submit(self._release, drone, before)
        return OVERTAKEN if overtaken else ""

    def _release(self, drone: str, before: int) -> None:
        """Release a drone once the world has the mode that was sent with an operator's priority."""
        self._views.await_answer(drone, before, ACCEPTANCE_TIMEOUT_S)
        with suppress(ZsimError):  # the run has ended
            self._request(keys.CONTROL, "release", {"drone": drone})


def _refusal_of(act: Callable[..., str], *args: Any) -> str:
    try:
        return act(*args)
    except ZsimError as error:
        return str(error)
    except Exception as error:  # a pool's thread reports no exception itself
        return f"{type(error).__name__}: {error}"


@dataclass
class _DroneTasks:
    busy: int = 0  # that run
    waiting: deque[Task] = field(default_factory=deque)


class DroneQueue:
    """Runs the tasks of each drone in order of submission in `pool`, urgent ones in `urgent`.

    Tasks of different drones do not wait for each other. Submitting raises RuntimeError once closed.
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
        """Run a task after all that were submitted for that name before."""
        with self._lock:
            tasks = self._tasks.get(name)
            if tasks is not None and tasks.busy:
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
        self._tasks.setdefault(name, _DroneTasks()).busy += 1

    def _end(self, name: str) -> None:
        with self._lock:
            tasks = self._tasks.get(name)
            if tasks is None:
                return  # closed
            tasks.busy -= 1
            if tasks.busy:
                return
            if tasks.waiting:
                self._start(self._pool, name, tasks.waiting.popleft())
            else:
                del self._tasks[name]
