"""Supervises the processes of a run: reacts when one of them ends, and finally ends them all.

The processes run on this machine (`ChildProcess`) or on others (`RemoteProcess`).
"""

import signal
import socket
import time
from collections import defaultdict, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple, Protocol

from zsim.errors import RunError
from zsim.runtime.progress import JsonProgress, ProgressSink
from zsim.scenario.roles import OnDeath, is_needed, lets_drop, on_death, on_overdue
from zsim.scenario.scenario import Processes
from zsim_deploy import USER_FAULT
from zsim_deploy.roles.closed_output import CLOSED, STREAMS, is_unread, redirect_output
from zsim_deploy.roles.stop_channel import REASONS, TWICE_INTERRUPTED, handled_by

# Wall times
POLL_S = 0.05  # polling interval of the processes
END_S = 8.0  # time for the others to end after the world; the recorder may have to wait for the disk
WORLD_FIRST_S = 1.0  # time for the world to end the run after Ctrl-C
INTERRUPT_S = 2.0  # time for all processes to end after Ctrl-C; zsim promises 3 s in all
SILENT_S = 10.0  # time after which a world without output is reported; it starts in 1 s, and announces compilation
QUIET_WORLD_S = 1.8  # time after which the world is reported silent; it writes its clock every second, even if waiting
TAKE_OVER_S = 60.0  # time after which a replaced process is killed; even a slow successor starts in half that time
RESTART_WINDOW_S = 20.0  # period in which restarts of a process are counted
OUTPUT_LOOK_S = 0.1  # interval between checks that the output is still read

RESTARTS_MAX = 5  # restarts allowed to a process within RESTART_WINDOW_S; if it needs more, restarting does not help
SUPERSEDED = 3  # exit code of a role whose name another process has taken over
UNREAD = "the output is no longer read"  # for example after `zsim run … | head`


class RunProcess(Protocol):
    name: str
    role: str
    restarts: int
    is_program: bool  # whether it is a user's program, whose pid here may differ from the one known to the world

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


def end_text(code: int | None, last_line: str) -> str:
    if code is not None and code < 0:
        return f"killed by signal {-code}"
    return f"exit code {code}" + (f": {last_line}" if last_line else "")


def last_line(log: Path) -> str:
    """Return the last line of a log; empty if the log is missing or empty."""
    try:
        lines = log.read_text(errors="replace").strip().splitlines()
    except OSError:
        return ""
    return lines[-1] if lines else ""


def status_row(role: str, host: str, pid: int, state: str, restarts: int = 0) -> dict[str, Any]:
    unknown = dict.fromkeys(("lag_ms", "messages_per_s", "round_trip_ms"))
    return {"role": role, "host": host, "pid": pid or None, "state": state, "restarts": restarts, **unknown}


@dataclass
class Outcome:
    reason: str
    failed: bool = False
    interrupted: bool = False


class Supervisor:
    """Starts the processes of a run, supervises them, and ends them all; `show` receives the progress."""

    def __init__(self, processes: Processes, show: ProgressSink) -> None:
        self.members: list[RunProcess] = []  # all processes, including the world; must be set before `run`
        self.survivor: RunProcess | None = None  # member that outlives the run; the caller must stop and close it
        self.clock: dict[str, Any] | None = None  # the world's latest clock line
        self._deaths = DeathPolicy(processes)
        self._show = show
        self._reason = ""
        self._failed = False
        self._flies = False
        self._interrupted: str | None = None
        self._until_s: float | None = None  # monotonic time by which the processes must leave
        self._silent_s: float | None = None  # monotonic time at which a world without any output is reported
        self._dead: set[str] = set()
        self._lost: dict[str, int | None] = {}  # pid of each process that ended without a bye message, by name
        self._leaving: dict[str, tuple[RunProcess, float]] = {}  # replaced processes, and since when [s; monotonic]
        self._left: list[RunProcess] = []  # replaced processes that have ended or were killed
        self._world_watch = WorldWatch()
        self._requests: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()

    def run(self, on_poll: Callable[[], None] = lambda: None) -> Outcome:
        """Start all processes, supervise them until the run ends, and end them all; call `on_poll` at every poll.

        Ctrl-C and SIGTERM end the run in an orderly way; a second signal raises KeyboardInterrupt without waiting.
        """
        if self._interrupted:
            return Outcome(self._interrupted, interrupted=True)

        def on_signal(number: int, _: object) -> None:
            if self._interrupted:
                raise KeyboardInterrupt(TWICE_INTERRUPTED)
            self._interrupted = REASONS[number]

        with handled_by(on_signal):
            try:
                for child in self.members:
                    if not child.is_program:  # programs may try to connect only once, so they start after the world
                        child.start()
                self._watch(on_poll)
                self._finish()
            finally:
                while not self._requests.empty():
                    self._requests.get()[1].cancel()
                replaced = [*(child for child, _ in self._leaving.values()), *self._left]
                members = [*(child for child in self.members if child is not self.survivor), *replaced]
                with ThreadPoolExecutor(len(members)) as pool:  # an unreachable process must not delay the others
                    for closed in [pool.submit(member.close) for member in members]:
                        closed.result()
        return Outcome(self._reason or "ended", self._failed, self._interrupted is not None)

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each process, for `zsim ps`; callable from any thread."""
        rows = []
        for child in self.members:
            state = "running" if child.code is None else f"ended ({child.outcome()})" if child.code else "ended"
            rows.append(status_row(child.name, socket.gethostname(), child.pid, state, child.restarts))
        return rows

    # Output of the world

    def handle_line(self, text: str) -> None:
        kind, content = JsonProgress.read(text)
        if not kind:
            return
        self._silent_s = None
        self._world_watch.last_s = time.monotonic()
        if kind == "clock":
            self._flies = self._flies or content.get("state") == "running"
            self.clock = content
            self._world_watch.clock(content)
        if kind == "event":
            self._on_event(content)
        else:
            getattr(self._show, kind)(content)

    def _on_event(self, event: dict[str, Any]) -> None:
        def give_up() -> None:
            for child in self.members:
                if child.name == subject:
                    self._dead.add(subject)
                    child.kill()

        self._show.event(event)
        kind, subject, data = event["kind"], event.get("subject", ""), event.get("data", {})
        if kind == "end":
            self._reason = self._reason or event["text"]
        elif kind == "overdue" and data.get("on_overdue") == "drop":  # the run continues without it
            self.submit(give_up)
        elif kind == "overdue" or (kind == "failure" and data.get("on_death") == "end"):
            self._fail(event["text"])
        elif kind == "death" and data.get("on_death") == "end":
            self._fail(f"{subject} died")
        elif kind == "death" and data.get("on_death") == "restart":
            self.submit(lambda: self._on_death(subject, data.get("pid")))

    def _on_death(self, name: str, pid: int | None) -> None:
        """Restart a process that the world reports dead, although its exit code does not show that.

        Either it was superseded by a process that has since died, or it ended with code 0 but without a bye message, as
        after `os._exit(0)`.
        """
        for child in self.members:
            if child.name == name and (child.pid == pid or child.is_program) and child.code in (0, None):
                self._lost[name] = child.pid
                self._dead.discard(name)
            elif child.name == name and child.code == SUPERSEDED and name in self._dead:
                self._show.say(f"{name} is restarted, because the process that replaced it is dead")
                self._dead.discard(name)
                child.restarts += 1
                child.start()

    # Watching

    def _watch(self, on_poll: Callable[[], None]) -> None:
        world = next(child for child in self.members if child.role == "world")
        self._silent_s = time.monotonic() + SILENT_S
        to_start = [child for child in self.members if child.is_program]
        while world.code is None or self._restarts_world(world):
            if self._interrupted:
                self._reason = self._interrupted
                world.request_stop(self._reason)
                world.wait(min(WORLD_FIRST_S, self._left_s()))
                return
            for child in self.members:
                if child is not world and child.code is not None and child.name not in self._dead:
                    self._on_exit(child, world)
            while not self._requests.empty():
                action, outcome = self._requests.get()
                if outcome.set_running_or_notify_cancel():
                    try:
                        outcome.set_result(action())
                    except Exception as error:  # whatever it is, the run continues
                        outcome.set_exception(error)
            while to_start and self._world_watch.last_s is not None:
                to_start.pop().start()
            self._release_replaced()
            if self._silent_s is not None and time.monotonic() > self._silent_s:
                self._silent_s = None
                silent = f"the world (pid {world.pid}) has not started within {SILENT_S:g} s"
                self._show.say(f"{silent}: {world.last_log_line() or 'its log is empty'}; the others are waiting")
            if line := self._world_watch.change(time.monotonic(), world.pid):
                self._show.say(line)
            on_poll()
            world.wait(POLL_S)
        if world.code != 0:
            self._fail(f"the world died: {world.outcome()}", after_end=True)

    def _restarts_world(self, world: RunProcess) -> bool:
        code = world.code
        has_flown = code is not None and code not in (0, USER_FAULT) and (self._flies or code < 0)
        return (
            has_flown
            and not self._reason
            and not self._interrupted
            and self._apply_on_death(world, flies=True) == "restart"
        )

    def _on_exit(self, child: RunProcess, world: RunProcess) -> None:
        """Apply `on_death` to a process that ended while the world runs."""
        is_superseded = child.code == SUPERSEDED and not child.is_program
        if is_superseded or (child.code == 0 and self._lost.get(child.name) != child.pid):
            self._dead.add(child.name)
            if is_superseded:
                self._show.say(child.last_log_line())
            return
        action = self._apply_on_death(child, self._flies)
        if action != "restart":
            self._dead.add(child.name)
        if action == "end":
            self._fail(f"{child.name} ended: {child.outcome()}")
            world.request_stop(self._reason)

    def _apply_on_death(self, child: RunProcess, flies: bool) -> OnDeath:
        """Decide what follows the death of a process, and restart it if so decided."""
        action, reason = self._deaths.decide(child.name, child.code, flies)
        if child.role != "world" or action == "restart":
            self._show.say(f"{child.name} (pid {child.pid}) ended: {child.outcome()}; {reason}")
        if action == "restart":
            child.restarts += 1
            child.start()
        return action

    def submit(self, action: Callable[[], Any]) -> Future[Any]:
        """Schedule a function to be called between two polls of the processes; callable from any thread.

        The returned future is cancelled if the run ends first.
        """
        outcome: Future[Any] = Future()
        self._requests.put((action, outcome))
        return outcome

    def interrupt(self, reason: str) -> None:
        self._interrupted = self._interrupted or reason

    def replace(self, new: RunProcess) -> None:
        """Start a process that replaces the one with the same name, which then leaves or is killed.

        Raises RunError while the old process is itself replacing another: the last one started might not be the last to
        join.
        """
        self._release_replaced()
        if self.is_being_replaced(new.name):
            raise RunError(f"{new.name} is already being replaced; try again when the replaced process has ended")
        index = next(i for i, child in enumerate(self.members) if child.name == new.name)
        old, self.members[index] = self.members[index], new
        new.restarts = old.restarts + 1
        self._dead.discard(new.name)
        self._leaving[new.name] = (old, time.monotonic())
        if not old.pid:
            old.kill()  # if it is waiting for its host, it must not take the name back once the host is reachable
        new.start()

    def is_being_replaced(self, name: str) -> bool:
        """Whether a process of this name was replaced and has not left yet; callable from any thread."""
        return name in self._leaving

    def _release_replaced(self) -> None:
        for name, (child, since_s) in list(self._leaving.items()):
            hangs = child.code is None and time.monotonic() - since_s > TAKE_OVER_S
            if hangs:
                self._show.say(f"{name} (pid {child.pid}) has not left within {TAKE_OVER_S:g} s; it is killed")
                child.kill()
            if hangs or child.code is not None:
                del self._leaving[name]
                self._left.append(child)

    def _fail(self, reason: str, after_end: bool = False) -> None:
        """Note a failure; `after_end`: it overrides an orderly end reported earlier, but not an interruption."""
        if after_end and not self._failed and not self._interrupted:
            self._reason = ""
        self._reason, self._failed = self._reason or reason, True

    def _finish(self) -> None:
        """Let all processes leave; after an orderly end the recorder leaves last, on its own."""
        members = [child for child in self.members if child is not self.survivor]
        programs = [child for child in members if child.is_program and child.name not in self._dead]
        for program in programs:  # they may have died since the last poll
            if program.code and self._deaths.decide(program.name, program.code, self._flies).action == "end":
                self._fail(f"{program.name} ended: {program.outcome()}", after_end=True)
        for child in members:
            if self._failed or self._interrupted or child.role != "recorder":
                child.request_stop(self._reason)
        for child in members:
            while not child.wait(min(POLL_S, self._left_s())) and self._left_s() > 0:
                continue
        for program in programs:
            if program.code:
                self._show.say(f"{program.name} ended: {program.outcome()}")
        recorder = next(child for child in members if child.role == "recorder")
        if recorder.code not in (0, None) and recorder.name not in self._dead:
            self._fail(f"the recorder ended: {recorder.outcome()}", after_end=True)

    def _left_s(self) -> float:
        """Return how long the processes still have to leave, wall time; Ctrl-C shortens it."""
        now_s = time.monotonic()
        latest_s = now_s + (INTERRUPT_S if self._interrupted else END_S)
        self._until_s = latest_s if self._until_s is None else min(self._until_s, latest_s)
        return max(0.0, self._until_s - now_s)


class DeathDecision(NamedTuple):
    action: OnDeath
    why: str


class DeathPolicy:
    """Decides what follows the death of a process, from the scenario and the process's earlier deaths."""

    def __init__(self, processes: Processes) -> None:
        self._processes = processes
        self._deaths: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=RESTARTS_MAX + 1))

    def decide(self, name: str, code: int | None, flies: bool) -> DeathDecision:
        """Count the death of a process, and return what to do and why; `flies`: whether the run has begun."""
        processes, role = self._processes, name.partition(".")[0]
        action = on_death(processes.on_death, name)
        if action == "end":
            return DeathDecision("end", "on_death: end")
        is_settled = flies and (action == "wait" or lets_drop(processes.on_death, name))  # the scenario decides
        ends, reason = False, ""
        if code == USER_FAULT and not is_settled:
            ends, reason = is_needed(name), "a restart would not help"
        elif action == "restart":
            deaths = self._deaths[name]
            deaths.append(time.monotonic())
            if len(deaths) > RESTARTS_MAX and deaths[-1] - deaths[0] < RESTART_WINDOW_S:
                reason = f"more than {RESTARTS_MAX} restarts within {RESTART_WINDOW_S:g} s"
        if not reason:
            return DeathDecision(action, f"on_death: {action}")
        overdue = on_overdue(processes.on_overdue or {}, name, gating=processes.gating or ())
        ends = ends or overdue == "end" or processes.gates(role)
        is_awaited = not flies and not is_needed(name) and name in (processes.expect or ())
        if ends or is_awaited:  # a run that has not begun would wait for an expected process indefinitely
            return DeathDecision("end", f"{reason}; the run ends")
        return DeathDecision("drop", f"{reason}; it is dropped, and the run continues without it")


class WorldWatch:
    """Detects that the world has fallen silent, which a stopped process cannot report itself.

    The world is not reported silent before its first line, because it may be compiling.
    """

    def __init__(self) -> None:
        self.last_s: float | None = None  # monotonic time of the world's last line; set by any thread
        self._is_silent = False
        self._ends_for: list[str] = []

    def clock(self, line: dict[str, Any]) -> None:
        """Remember the processes for which an ended world waits: it closes its links once they have read everything."""
        if line.get("state") == "stopped":
            self._ends_for = [each["name"] for each in line.get("waiting_for", ())]

    def change(self, now_s: float, pid: int) -> str | None:
        """Return a line when the world has fallen silent or is back; otherwise None."""
        if self.last_s is None or self._is_silent == (now_s - self.last_s >= QUIET_WORLD_S):
            return None
        self._is_silent = not self._is_silent
        if not self._is_silent:
            return f"world (pid {pid}) is back"
        if self._ends_for:
            names = ", ".join(self._ends_for)
            return f"world (pid {pid}) has ended and is waiting for {names}, which may be stopped or out of reach"
        silent_s = now_s - self.last_s
        hint = f"kill -CONT {pid} continues it"
        return f"world (pid {pid}) has shown no sign of life for {silent_s:.1f} s: stopped ({hint}) or out of reach"


class EndSignals:
    """A context manager that handles SIGTERM and SIGHUP; SIGHUP stays ignored under nohup.

    SIGTERM raises KeyboardInterrupt. SIGHUP, sent when the terminal closes, raises nothing, because shells send it more
    than once; instead `hung_up` is called, and further output goes to the file `log`.
    """

    def __init__(self, log: Path, hung_up: Callable[[], None]) -> None:
        self._log = log
        self._hung_up = hung_up
        self.reason = ""  # why the output can no longer be seen
        self._looked_s = 0.0

    def __enter__(self) -> "EndSignals":
        handlers: dict[int, Any] = {signal.SIGTERM: signal.default_int_handler}
        if hasattr(signal, "SIGHUP"):  # not on Windows
            handlers[signal.SIGHUP] = self._on_hangup
        self._previous = {number: signal.getsignal(number) for number in handlers}
        for number, handler in handlers.items():
            if self._previous[number] is not signal.SIG_IGN:
                signal.signal(number, handler)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _on_hangup(self, *_: object) -> None:
        self.reason = CLOSED
        redirect_output(self._log)
        self._hung_up()

    def look(self) -> str:
        """Return why the output can no longer be seen; empty if it can be. Must be called repeatedly."""
        if time.monotonic() - self._looked_s >= OUTPUT_LOOK_S:
            if unread := [stream for stream in STREAMS if is_unread(stream)]:
                self.reason = self.reason or UNREAD
                redirect_output(self._log, unread, UNREAD)
            if STREAMS[-1] in unread:
                self._hung_up()
            self._looked_s = time.monotonic()
        return self.reason
