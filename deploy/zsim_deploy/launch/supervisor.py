"""The watch over the processes of a run: what is done when one of them ends, and how all of them end.

Where a process runs, on this machine (`ChildProcess`) or on another one (`RemoteProcess`), makes no difference here.
"""

import json
import socket
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Protocol

from zsim.errors import RunError
from zsim.runtime.progress import ProgressSink
from zsim.scenario.scenario import Processes
from zsim_deploy import USER_FAULT
from zsim_deploy.launch.death_policy import SUPERSEDED, DeathPolicy
from zsim_deploy.launch.world_watch import WorldWatch
from zsim_deploy.roles.stop_channel import REASONS, TWICE_INTERRUPTED, handled_by

POLL_S = 0.05  # how often the processes are looked at
END_S = 8.0  # after the world has ended, how long the others may take; the recorder may have a disk to wait for
WORLD_FIRST_S = 1.0  # after Ctrl-C, how long the world has to end the run for everybody
INTERRUPT_S = 2.0  # after Ctrl-C, how long anybody may take; the whole is promised within 3 s
SILENT_S = 10.0  # after which a world that has printed nothing is named; it takes 1 s, and compiles with a notice
TAKE_OVER_S = 60.0  # how long a process may stay once another was started in its place; a slow one starts in half


class RunProcess(Protocol):
    """A process of a run."""

    name: str
    role: str
    restarts: int

    @property
    def pid(self) -> int: ...
    @property
    def code(self) -> int | None: ...
    def start(self) -> None: ...
    def outcome(self) -> str: ...
    def last_log_line(self) -> str: ...
    def request_stop(self, reason: str) -> None: ...
    def wait(self, timeout_s: float) -> bool: ...
    def kill(self) -> None: ...
    def close(self) -> None: ...


@dataclass
class Outcome:
    """How a run ended."""

    reason: str
    failed: bool = False
    interrupted: bool = False


class Supervisor:
    """Starts the processes of a run, watches them, and leaves nothing behind.

    Args:
        processes: what the scenario says of their deaths.
        show: takes progress.

    Attributes:
        members: to be given before `run`; the world among them.
        lasting: the one of them that goes on after the run, to be stopped and closed by the caller, whatever happens.
    """

    def __init__(self, processes: Processes, show: ProgressSink) -> None:
        self.members: list[RunProcess] = []
        self.lasting: RunProcess | None = None
        self._deaths = DeathPolicy(processes)
        self._show = show
        self._reason = ""
        self._failed = False
        self._flies = False
        self._interrupted: str | None = None
        self._until_s: float | None = None
        self._silent_s: float | None = None  # when a world without a line of its own is to be named (monotonic)
        self._dead: set[str] = set()
        self._lost: dict[str, int | None] = {}  # pid of who has ended without a bye
        self._leaving: dict[str, tuple[RunProcess, float]] = {}  # replaced processes, and since when (monotonic, s)
        self._gone: list[RunProcess] = []  # nobody waits for them any more
        self._world_watch = WorldWatch()
        self.clock: dict[str, Any] | None = None  # the world's last
        self._requests: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()

    def run(self, look: Callable[[], None] = lambda: None) -> Outcome:
        """Start everything, watch it to its end, leave nothing behind.

        Args:
            look: called at every look at the processes.
        """
        if self._interrupted:
            return Outcome(self._interrupted, interrupted=True)
        with self._interrupts():
            try:
                for child in self.members:
                    child.start()
                self._watch(look)
                self._finish()
            finally:
                self._cancel_requests()
                replaced = [*(child for child, _ in self._leaving.values()), *self._gone]
                _close([*self._leaving_with_run(), *replaced])
        return Outcome(self._reason or "ended", self._failed, self._interrupted is not None)

    def _leaving_with_run(self) -> list[RunProcess]:
        return [child for child in self.members if child is not self.lasting]

    def _interrupts(self) -> AbstractContextManager[None]:
        """Take Ctrl-C and SIGTERM as a request to end the run in order; a second Ctrl-C does not wait."""

        def on_signal(number: int, _: object) -> None:
            if self._interrupted:
                raise KeyboardInterrupt(TWICE_INTERRUPTED)
            self._interrupted = REASONS[number]

        return handled_by(on_signal)

    def handle_line(self, text: str) -> None:
        """Take a line of the world's progress."""
        try:
            line = json.loads(text)
        except ValueError:
            return  # not progress: something printed by a library
        if not isinstance(line, dict):
            return  # a number that was printed is JSON too
        self._silent_s = None
        self._world_watch.received(time.monotonic())
        if "clock" in line:
            self._flies = self._flies or line["clock"].get("state") == "running"
            self.clock = line["clock"]
            self._world_watch.clock(line["clock"])
            self._show.clock(line["clock"])
        elif "event" in line:
            self._on_event(line["event"])
        elif "health" in line:
            self._show.health(line["health"])
        elif "say" in line:
            self._show.say(line["say"])

    def _on_event(self, event: dict[str, Any]) -> None:
        self._show.event(event)
        if event["kind"] == "end":
            self._reason = self._reason or event["text"]
        elif event["kind"] == "overdue":
            self._on_overdue(event)
        elif event["kind"] == "failure" and event["data"].get("on_death") == "end":
            self._fail(event["text"])
        elif event["kind"] == "death" and event["data"].get("on_death") == "end":
            self._fail(f"{event['subject']} died")
        elif event["kind"] == "death" and event["data"].get("on_death") == "restart":
            self.submit(lambda: self._on_death(event["subject"], event["data"].get("pid")))

    def _on_overdue(self, event: dict[str, Any]) -> None:
        """End what has not come back in its time, if the run goes on without it."""
        if event["data"].get("on_overdue") == "drop":
            self.submit(lambda: self._give_up(event["subject"]))
        else:
            self._fail(event["text"])

    def _give_up(self, name: str) -> None:
        for child in self.members:
            if child.name == name:
                self._dead.add(name)
                child.kill()

    def rows(self) -> list[dict[str, Any]]:
        """Return name, process number, state and restarts of each process, for `zsim ps`; callable from any thread."""
        host = socket.gethostname()
        return [
            {
                "role": child.name,
                "host": host,
                "pid": child.pid or None,
                "state": "running" if child.code is None else f"ended ({child.outcome()})" if child.code else "ended",
                "lag_ms": None,
                "messages_per_s": None,
                "round_trip_ms": None,
                "restarts": child.restarts,
            }
            for child in self.members
        ]

    # Watching

    def _watch(self, look: Callable[[], None]) -> None:
        """Return when the world has ended, or when it has to."""
        world = next(child for child in self.members if child.role == "world")
        self._silent_s = time.monotonic() + SILENT_S
        while world.code is None or self._restarts_world(world):
            if self._interrupted:
                self._reason = self._interrupted
                world.request_stop(self._reason)
                world.wait(min(WORLD_FIRST_S, self._left_s()))
                return
            for child in self.members:
                if child is not world and child.code is not None and child.name not in self._dead:
                    self._on_exit(child, world)
            self._carry_out_requests()
            self._release_replaced()
            self._name_silent(world)
            if line := self._world_watch.change(time.monotonic(), world.pid):
                self._show.say(line)
            look()
            world.wait(POLL_S)
        if world.code != 0:
            self._fail_after_end(f"the world died: {world.outcome()}")

    def _restarts_world(self, world: RunProcess) -> bool:
        """Start a world again that died in its run; return whether that was so."""
        code = world.code
        flew = code is not None and code not in (0, USER_FAULT) and (self._flies or code < 0)
        if not flew or self._reason or self._interrupted:
            return False
        action, why = self._deaths.decide(world.name, code, flies=True)
        if action != "restart":
            return False
        self._show.say(f"{world.name} (pid {world.pid}) ended: {world.outcome()}; {why}")
        world.restarts += 1
        world.start()
        return True

    def submit(self, act: Callable[[], Any]) -> Future[Any]:
        """Let the watch do something between two looks at the processes; callable from any thread.

        Returns:
            what comes of it, also if it fails; cancelled when the run ends before.
        """
        outcome: Future[Any] = Future()
        self._requests.put((act, outcome))
        return outcome

    def interrupt(self, reason: str) -> None:
        """End the run for everybody, as Ctrl-C does."""
        self._interrupted = self._interrupted or reason

    def replace(self, new: RunProcess) -> None:
        """Start a process that takes the place of the one of its name, which then leaves or is killed.

        Raises:
            RunError: another one is taking that place at this moment; the last to come would not be the last to join.
        """
        self._release_replaced()
        if self.is_being_replaced(new.name):
            raise RunError(f"{new.name} is being taken over already; try again when its former process has ended")
        index = next(i for i, child in enumerate(self.members) if child.name == new.name)
        old, self.members[index] = self.members[index], new
        new.restarts = old.restarts + 1
        self._dead.discard(new.name)
        self._leaving[new.name] = (old, time.monotonic())
        if not old.pid:
            old.kill()  # it waits for its host, and must not take the name back when that is there
        new.start()

    def is_being_replaced(self, name: str) -> bool:
        """Return whether a process is taking the place of another that has not left yet; callable from any thread."""
        return name in self._leaving

    def _release_replaced(self) -> None:
        """Let go of those that have left their place; kill one that hangs there."""
        for name, (child, since_s) in list(self._leaving.items()):
            hangs = child.code is None and time.monotonic() - since_s > TAKE_OVER_S
            if hangs:
                self._show.say(f"{name} (pid {child.pid}) has not made way within {TAKE_OVER_S:g} s; it is killed")
                child.kill()
            if hangs or child.code is not None:
                del self._leaving[name]
                self._gone.append(child)

    def _carry_out_requests(self) -> None:
        while not self._requests.empty():
            act, outcome = self._requests.get()
            if outcome.set_running_or_notify_cancel():
                _settle(outcome, act)

    def _cancel_requests(self) -> None:
        while not self._requests.empty():
            self._requests.get()[1].cancel()

    def _on_exit(self, child: RunProcess, world: RunProcess) -> None:
        """Apply on_death to a role that ended while the world runs."""
        if child.code == SUPERSEDED or (child.code == 0 and self._lost.get(child.name) != child.pid):
            self._dead.add(child.name)
            if child.code == SUPERSEDED:
                self._show.say(child.last_log_line())
            return
        action, why = self._deaths.decide(child.name, child.code, self._flies)
        self._show.say(f"{child.name} (pid {child.pid}) ended: {child.outcome()}; {why}")
        if action == "restart":
            child.restarts += 1
            child.start()
            return
        self._dead.add(child.name)
        if action == "end":
            self._fail(f"{child.name} ended: {child.outcome()}")
            world.request_stop(self._reason)

    def _on_death(self, name: str, pid: int | None) -> None:
        """Take it from the world that a process has died, if nobody else would start it again.

        It has left its place to the one that is dead now, or has ended with 0 without a bye, as by `os._exit(0)`.
        """
        for child in self.members:
            if child.name == name and child.pid == pid and child.code in (0, None):
                self._lost[name] = pid
                self._dead.discard(name)
            elif child.name == name and child.code == SUPERSEDED and name in self._dead:
                self._show.say(f"{name} is started again, since who took its place is dead")
                self._dead.discard(name)
                child.restarts += 1
                child.start()

    def _name_silent(self, world: RunProcess) -> None:
        """Show once whom all others wait for, where the world has not begun."""
        if self._silent_s is not None and time.monotonic() > self._silent_s:
            self._silent_s = None
            last = world.last_log_line() or "its log is empty"
            self._show.say(f"the world (pid {world.pid}) has not begun after {SILENT_S:g} s: {last}; the others wait")

    def _fail(self, reason: str) -> None:
        self._reason, self._failed = self._reason or reason, True

    def _fail_after_end(self, reason: str) -> None:
        """Take a failure of who was to end with the run: that counts, and no end in order that the world reported."""
        if not self._failed and not self._interrupted:
            self._reason = ""
        self._fail(reason)

    def _finish(self) -> None:
        """Let everybody leave; the recorder leaves last, by itself."""
        members = self._leaving_with_run()
        for child in members:
            if self._failed or self._interrupted or child.role != "recorder":
                child.request_stop(self._reason)
        for child in members:
            while not child.wait(min(POLL_S, self._left_s())) and self._left_s() > 0:
                continue
        recorder = next(child for child in members if child.role == "recorder")
        if recorder.code not in (0, None) and recorder.name not in self._dead:
            self._fail_after_end(f"the recorder ended: {recorder.outcome()}")

    def _left_s(self) -> float:
        """Return how long the others may still take, now that the run is to end; Ctrl-C makes it shorter."""
        now_s = time.monotonic()
        latest_s = now_s + (INTERRUPT_S if self._interrupted else END_S)
        self._until_s = latest_s if self._until_s is None else min(self._until_s, latest_s)
        return max(0.0, self._until_s - now_s)


def _settle(outcome: Future[Any], act: Callable[[], Any]) -> None:
    """Carry out a request; its future gets any exception, and the run goes on."""
    try:
        outcome.set_result(act())
    except Exception as error:
        outcome.set_exception(error)


def _close(members: Sequence[RunProcess]) -> None:
    """End all of them at once, so one that cannot be reached does not delay the others."""
    with ThreadPoolExecutor(len(members)) as pool:
        for closed in [pool.submit(member.close) for member in members]:
            closed.result()
