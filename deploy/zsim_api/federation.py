"""A flight under test: real processes and the user's own programs, with a test that observes and intervenes.

    with zsim.Federation("step.yaml", duration=40, programs=["python my_controller.py --connect {endpoint}"]) as flight:
        flight.wait_until("engaged")
        flight.inject({"kind": "gps_dropout", "target": "drone2", "for_s": 10})
        flight.kill("estimator.drone2")
        flight.assert_errors(p=0.3, window=(20, 40))

The test takes part in the lockstep as `test.federation`: simulated time stands still unless the test waits for
something, so its actions take effect at the same gate in every run. The fixture `federation` of the pytest plugin
creates these objects.
"""

import os
import re
import shlex
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, get_args

from msgspec import UNSET

from zsim.contract import keys
from zsim.contract.flight_messages import ClusterState, Phase, Truth
from zsim.contract.messages import Info, decode
from zsim.contract.run_messages import EVENT_KINDS, Clock, Event, Waiting, holding_up
from zsim.errors import DecodeError, RunError, RunFailedError, ZsimError, printable
from zsim.runtime.agent import Agent, Output
from zsim.runtime.runner import Runner
from zsim.scenario.roles import RECORDER, WORLD, expected_processes
from zsim.schema.checker import show, suggestion
from zsim.transport.connection import find_world
from zsim.transport.session import RawSample, ReceivedSample, Session, result_of
from zsim_analysis.in_process import OwnAgent, sequence_of_agents, with_agents
from zsim_api import run_folder
from zsim_api.assertions import Assertions
from zsim_api.commands import PilotedDrone
from zsim_api.flight import LAUNCHER, calling, command_of, raise_failure
from zsim_api.programs import Program, environment_of, fill_placeholders, search_path
from zsim_api.scenarios import AnyScenario, scenario_of

if TYPE_CHECKING:
    from zsim_api.recorded import Run

PROCESS = "test.federation"
PATIENCE_S = 300.0  # wall time; the first run on a machine compiles for one to three minutes, more on a busy one
PROGRAM_END_S = 5.0  # wall time for programs to notice the end of the run
KILL = getattr(signal, "SIGKILL", signal.SIGTERM)  # Windows has no SIGKILL
HARMLESS = {getattr(signal, name, None) for name in ("SIGSTOP", "SIGCONT")}  # signals that do not end a process
LAST_LINES = 40  # number of last lines shown of a log that may explain a failure
ENDED = re.compile(r"^(\S+)(?: \(pid \d+\))? ended: ", re.MULTILINE)  # line in the launcher's log


class Moment(NamedTuple):
    """The state of a flight at a gate, passed to a condition of `wait_until`.

    Attributes:
        t_s: simulated time [s].
        states: the newest received states of the clusters by name; in lockstep, usually two gates old.
        truth: the true motion of the drones by name, except that of external ones.
        events: events since the last `wait_until`.
    """

    t_s: float
    states: Mapping[str, ClusterState]
    truth: Mapping[str, Truth]
    events: Sequence[Event]


Condition = Callable[[Moment], Any]


class Federation(Assertions):
    """A flight as processes: `zsim run` on a free port, in a federation of its own, together with the user's programs.

    Args:
        scenario: path, `zsim.Scenario`, or a mapping as in YAML.
        duration: simulated time of the flight [s]; None: that of the scenario.
        seed, set, law, estimator, out: as in `zsim.run`; an earlier run in `out` is replaced.
        agents: your own agents, as in `zsim.run`, or as strings for `zsim run --agent`, "MODULE:CLASS NAME=VALUE".
        programs: command lines of your own programs, in any language, each a string or a list of words. `{endpoint}`,
            `{federation}`, `{folder}` and `{name}` are replaced, and ZSIM_CONNECT and ZSIM_FEDERATION are set.
            Simulated time starts only once every program with a name ("ground.main=python ground.py") has joined.
            A program that ends with a code other than 0 fails the flight, unless the test has killed it.
        options: further options of `zsim run`, such as "--hosted", or "--rate" and "1".
        modules: folders with the modules of named classes, in addition to those of the scenario.

    Attributes:
        endpoint, name: the endpoint of the world; the name of the federation.
        folder: the run's folder, with the record and the logs.

    Raises:
        ScenarioError, RunError: the flight is not possible; nothing was started.
    """

    def __init__(
        self,
        scenario: AnyScenario,
        duration: float | None = None,
        *,
        seed: int | None = None,
        set: Mapping[str, Any] | None = None,
        agents: Sequence[OwnAgent | str] = (),
        programs: Sequence[str | Sequence[str]] = (),
        law: type | None = None,
        estimator: type | None = None,
        options: Sequence[str] = (),
        out: str | Path | None = None,
        modules: Sequence[str | Path] = (),
    ) -> None:
        if not hasattr(os, "killpg"):
            raise RunError("Federation: needs POSIX signals; use Linux, macOS or WSL, or zsim.run in one process")
        self._port = _reserved_port()
        self.endpoint = f"tcp/127.0.0.1:{self._port.getsockname()[1]}"
        self.name = str((set or {}).get("federation", f"test-{os.getpid()}-{self._port.getsockname()[1]}"))
        named_programs: list[tuple[str, list[str]]] = [_split_program(each) for each in programs]
        try:
            source = scenario_of(scenario).changed(
                seed=seed, duration_s=duration, set=set, law=law, estimator=estimator
            )
            own = [each for each in sequence_of_agents(agents) if not isinstance(each, str)]
            agent_texts = [each for each in agents if isinstance(each, str)]
            resolved, own_agents = calling(lambda: with_agents(source.resolved, own))
            expected = [*expected_processes(resolved), *(name for name, _ in named_programs if name), PROCESS]
            changed: dict[str, Any] = {"federation": self.name, "processes.expect": expected}
            changed["processes.on_death"] = {**resolved.processes.on_death, PROCESS: "drop"}
            source = source.with_(changed)
            self.folder = run_folder.make_directory(Path(out) if out is not None else None, resolved, force=True)
            source.keep_modules(self.folder)
            logs = self.folder / run_folder.LOGS
            logs.mkdir(exist_ok=True)
        except BaseException:
            self._port.close()
            raise
        self._watch = _Watch()
        self._known_names = {*expected, WORLD, RECORDER}
        self._has_others = bool(agent_texts or options) or any(
            not name for name, _ in named_programs
        )  # processes whose names are unknown
        self._clock: Clock | None = None
        self._pids: dict[str, int] = {}
        self._killed: dict[int, str] = {}
        self._link: Session | None = None
        self._is_closed = False
        self._run: Run | None = None
        arguments = [word for each in agent_texts for word in ("--agent", each)]
        launched = ["--listen", self.endpoint, *arguments, *options]
        command, environment = command_of(source, own, [agent.name for agent in own_agents], launched, self.folder)
        environment["PYTHONPATH"] = search_path([*modules, environment["PYTHONPATH"]])
        self._launcher = Program(command, environment, logs / f"{LAUNCHER}.log")
        self._environment = environment | environment_of(self.endpoint, self.name)
        self._programs: dict[str, Program] = {}
        self._threads: list[threading.Thread] = []
        self._start_thread(self._take_part)
        self._start_thread(self._await_end, self._launcher)
        for name, arguments in named_programs:
            self._start(name, arguments)

    def _start_thread(self, target: Callable[..., None], *arguments: Program) -> None:
        self._threads.append(threading.Thread(target=target, args=arguments, daemon=True))
        self._threads[-1].start()

    def _start(self, name: str, words: Sequence[str]) -> None:
        label = name or f"program-{len(self._programs) + 1}"
        log = self.folder / run_folder.LOGS / f"{label}.log"
        values = {"endpoint": self.endpoint, "federation": self.name, "folder": str(self.folder), "name": label}
        self._programs[label] = Program(fill_placeholders(words, values), self._environment, log)
        self._start_thread(self._await_end, self._programs[label])

    # Time

    @property
    def t_s(self) -> float:
        """Current simulated time [s]; 0 before the flight begins."""
        moment = self._watch.moment
        return moment.t_s if moment else 0.0

    def wait_until(self, what: str | float | Condition, within_s: float = PATIENCE_S) -> Moment:
        """Let simulated time pass until a condition is met, and stop it there; in realtime, it continues.

        Args:
            what: a phase that every cluster must be in, such as "engaged" (met at once if all already are, even just
                after a `kill`); a kind of event, such as "collision" or "restart", since the last call; a simulated
                time [s]; or a function of a `Moment`.
            within_s: limit in wall time.

        Returns:
            The moment at which the condition was met.

        Raises:
            RunError: `what` is not a phase, a kind of event, a time or a function.
            RunFailedError: the run ended first, a program failed, or `within_s` has passed.
            Exception: raised by the function.
        """
        __tracebackhide__ = True
        condition, text = _condition(what)
        watch, until_s = self._watch, time.monotonic() + within_s
        with watch.news:
            watch.begin(condition)
            while watch.condition is condition and self._fault is None:
                if not watch.news.wait(max(0.0, until_s - time.monotonic())):
                    break
            is_waiting, watch.condition = watch.condition is condition, None
            if watch.raised is not None:
                raise watch.raised
            if not is_waiting and watch.moment is not None:
                return watch.moment
        if self._watch.has_left:  # the launcher's log says why
            self._launcher.wait(max(0.0, until_s - time.monotonic()))
        fault = self._fault or f"not reached within {within_s:g} s of wall time"
        raise RunFailedError(f"{self.folder.name}: waiting for {text} from {self.t_s:.2f} s on: {fault}")

    def run(self, within_s: float = PATIENCE_S) -> "Run":
        """Let simulated time pass until the end of the run; return the recorded run, as `zsim.load` does.

        Args:
            within_s: limit in wall time.

        Raises:
            RunFailedError: a failure ended the run, a program ended with a code other than 0, or `within_s` has passed.
        """
        if self._run is None:
            self._watch.finish()
            code = self._launcher.wait(within_s)
            if code is None:
                raise RunFailedError(f"{self.folder.name}: the run has not ended within {within_s:g} s of wall time")
            until_s = time.monotonic() + PROGRAM_END_S
            for program in self._programs.values():
                program.wait(max(0.0, until_s - time.monotonic()))
                program.close()
            if fault := self._program_fault():
                raise RunFailedError(f"{self.folder.name}: {fault}")
            if code:
                raise_failure(self.folder, code)
            from zsim_api.recorded import load

            self._run = load(self.folder, trust=True)
        return self._run

    # Interventions

    def ask(self, key: str, op: str, within_s: float = PATIENCE_S, **args: Any) -> Any:
        """Send a request to the world, a controller or a pilot, as `zsim ask` does.

        For example, `ask("cluster/main/control", "target", values={…})`.

        Args:
            key: `world/control`, `cluster/NAME/control` or `drone/NAME/control`.
            op, args: the request, as in docs/protocol.md.
            within_s: wall time to wait for the world.

        Raises:
            RequestRefusedError: the request was refused, for the reason given.
            RunError: no answer came.
        """
        return result_of(self._session(within_s).request(key, op, PROCESS, args))

    def drone(self, name: str) -> PilotedDrone:
        """Return a drone that can be asked to fly somewhere, if it has a `reference` in the scenario."""
        return PilotedDrone(name, self.ask)

    def inject(self, fault: Mapping[str, Any]) -> Any:
        """Inject a fault, as in a scenario's `faults`; see docs/faults.md.

        In lockstep, a fault without `at_s` acts from the first gate that the world cannot have computed yet, which is
        the same in each run: `time.command_delay_gates` + 1 gates after `t_s`.

        Returns:
            `id`, `from_ns` and `until_ns` of the fault.

        Raises:
            RequestRefusedError: the fault was refused, for the reason given.
        """
        self._session(PATIENCE_S)
        start = {} if (ahead_s := self._watch.ahead_s) is None else {"at_s": round(self.t_s + ahead_s, 9)}
        return self.ask(keys.CONTROL, "fault_add", **{**start, **fault})

    def kill(self, process: str, number: int = KILL, within_s: float = PATIENCE_S) -> int:
        """Send a signal to a process of the run, SIGKILL by default; return its process id.

        Args:
            process: its name, such as "estimator.drone2" or "world", or "ground.main" for a program of yours.
            number: number of the signal, such as SIGSTOP, which stops the process until SIGCONT.
            within_s: wall time to wait until the process has joined.

        Raises:
            RunError: no process of the run has that name.
            RunFailedError: the process has not joined in time.
        """
        until_s = time.monotonic() + within_s
        self._check_name(process, within_s)
        with self._watch.news:
            self._await(
                lambda: self._pids.get(process, -1) not in {-1, *self._killed}, until_s, f"{process} has not joined"
            )
            pid = self._pids[process]
            if number not in HARMLESS:
                self._killed[pid] = process
                if process in self._programs:
                    self._programs[process].end_requested = True
        with suppress(ProcessLookupError):
            os.kill(pid, number)
        return pid

    def start(self, program: str) -> None:
        """Restart one of your programs that has ended or was killed.

        Raises:
            RunError: no program has this name, or it is still running.
        """
        previous = self._programs.get(program)
        if previous is None:
            hint = f"must be one of {', '.join(self._programs)}" if self._programs else "the flight has no programs"
            raise RunError(f"start: program is {program!r}; {hint}")
        if previous.wait(PROGRAM_END_S if previous.end_requested else 0.0) is None:
            raise RunError(f"start: {program} is running; must have ended")
        previous.close()
        self._start(program, previous.words)

    def _check_name(self, process: str, within_s: float) -> None:
        """Raise RunError unless a process of the run has, or is expected to have, the name."""
        if process in self._known_names:
            return
        watch = self._watch
        with watch.news:
            if self._has_others:  # by the first gate, all expected processes have joined
                watch.news.wait_for(lambda: watch.moment is not None or self._fault is not None, within_s)
            link = self._link
        for sample in link.get(keys.process("*", "join")) if link else ():  # processes that joined before this test
            self._take_process(sample)
        allowed = sorted({*self._known_names, *self._pids} - {PROCESS})
        if process not in allowed:
            raise RunError(
                f"kill: process is {process!r}; {suggestion(process, allowed)}must be one of {', '.join(allowed)}"
            )

    def _session(self, within_s: float) -> Session:
        with self._watch.news:
            self._await(lambda: self._link is not None, time.monotonic() + within_s, f"no world within {within_s:g} s")
            assert self._link is not None
            return self._link

    def _await(self, is_met: Callable[[], bool], until_s: float, failure: str) -> None:
        """Wait until a condition is met; raise RunFailedError once the run is over or the time has passed."""
        while not is_met():
            if self._fault is not None or not self._watch.news.wait(max(0.0, until_s - time.monotonic())):
                raise RunFailedError(f"{self.folder.name}: {self._fault or failure}")

    # End

    def close(self) -> None:
        """End all processes of the flight; the record contains everything up to that point."""
        self._is_closed = True
        self._watch.finish()
        self._launcher.close()
        for program in self._programs.values():
            program.close()
        for thread in self._threads:
            thread.join()
        self._port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def diagnosis(self) -> str:
        """Return a text on the progress of the run, the processes that it waits for, and the last lines of the logs.

        The logs of failed and awaited processes come first, then the launcher's; then the last line of each other log.
        """
        clock = self._newest_clock()
        waiting = [each for each in clock.waiting_for if each.name != PROCESS] if clock else []
        parts = [self._progress(clock, waiting)]
        if fault := self._program_fault():
            parts.append(fault)
        logs = {log.stem: log.read_text(errors="replace") for log in (self.folder / run_folder.LOGS).glob("*.log")}
        failed = [name for name, program in self._programs.items() if program.code and not program.end_requested]
        failed += ENDED.findall(logs.get(LAUNCHER, ""))
        detailed = [*dict.fromkeys((*failed, *(each.name for each in waiting), LAUNCHER))]
        for name in (*detailed, *sorted(logs.keys() - {*detailed})):
            lines = logs.get(name, "").splitlines()
            last_lines = lines[-LAST_LINES:] if name in detailed else lines[-1:]
            if last_lines and name in detailed:
                note = f" (last {len(last_lines)} of {len(lines)} lines)" if len(last_lines) < len(lines) else ""
                parts.append("\n".join([f"--- {name}.log{note}", *last_lines]))
            elif last_lines:
                parts.append(f"--- {name}.log, last of {len(lines)} lines: {last_lines[0]}")
        return "\n".join(parts)

    def _progress(self, clock: Clock | None, waiting: Sequence[Waiting]) -> str:
        if clock is None:
            return "no clock message from a world was received"
        lines = [f"  {each}" for each in holding_up(clock.state, waiting) or waiting]
        if not self._watch.has_left and self._watch.condition is None:
            lines.append(f"  {PROCESS}, this test, which is not waiting for anything at the moment")
        lines.insert(0, f"t = {clock.t_ns / 1e9:.2f} s, {clock.state}; waiting_for:{'' if lines else ' none'}")
        return "\n".join(lines)

    def _newest_clock(self) -> Clock | None:
        link = self._link
        with suppress(ZsimError):
            for sample in link.get(keys.CLOCK) if link and self._launcher.code is None else ():
                self._take_clock(sample.payload)
        return self._clock

    # Background threads

    @property
    def _fault(self) -> str | None:
        """Why the run is over; None while it continues."""
        if fault := self._program_fault():
            return fault
        if (code := self._launcher.code) is not None:
            return f"the run has ended with code {code}: {self._last_line(LAUNCHER)}"
        return "the run has ended" if self._watch.has_left else None

    def _program_fault(self) -> str:
        for name, program in self._programs.items():
            if program.code and not program.end_requested:
                ended = f"ended with code {program.code}: {self._last_line(name)}"
                return f"{name} ({shlex.join(program.words)}) {ended}"
        return ""

    def _last_line(self, name: str) -> str:
        lines = (self.folder / run_folder.LOGS / f"{name}.log").read_text(errors="replace").splitlines()
        return lines[-1] if lines else "it printed nothing"

    def _await_end(self, program: Program) -> None:
        program.wait()
        with self._watch.news:
            self._watch.news.notify_all()

    def _take_part(self) -> None:
        """Take part in the run from start to end; the world waits for this participant."""

        def is_over() -> bool:
            return self._is_closed or self._launcher.code is not None

        try:
            with find_world(self.endpoint, self.name, None, stopped=is_over) as (link, info):
                link.declare_subscriber(keys.CLOCK, lambda sample: self._take_clock(sample.payload))
                for kind in ("join", "health"):
                    link.declare_subscriber(keys.process("*", kind), self._take_process)
                self._watch.watch(info)
                with self._watch.news:
                    self._link = link
                    self._watch.news.notify_all()
                Runner(link, info, self._watch, stopped=lambda: self._launcher.code is not None).run()
        except ZsimError as error:
            if not is_over():
                print(printable(f"{PROCESS}: {error}"), file=sys.stderr)
        finally:
            with self._watch.news:
                self._link, self._watch.has_left = None, True
                self._watch.news.notify_all()

    def _take_clock(self, payload: bytes) -> None:
        with suppress(DecodeError):
            self._clock = decode(keys.CLOCK, payload)

    def _take_process(self, sample: RawSample | ReceivedSample) -> None:
        with suppress(DecodeError):
            message = decode(sample.key, sample.payload)
            with self._watch.news:
                name = keys.thing(sample.key)
                if self._pids.get(name) != message.pid and message.pid not in self._killed and name != PROCESS:
                    self._pids[name] = message.pid
                    self._watch.news.notify_all()


class _Watch(Agent):
    """The test's participant in the lockstep, which completes a gate only once the test lets time pass.

    Attributes:
        news: condition variable that guards the other attributes and signals their changes.
        condition: the condition that the test waits for; None while simulated time stands still.
        moment: the moment of the newest gate; None before the first.
        raised: the exception that the condition raised.
        has_left: whether the participant has left the run.
        ahead_s: time from the newest gate to the first that the world cannot have computed yet [s]; None in realtime.
    """

    name = PROCESS
    uncounted = (keys.EVENT,)  # the event of a process's end carries the stamp of a gate that has already been received

    def __init__(self) -> None:
        super().__init__()
        self.news = threading.Condition()
        self.condition: Condition | None = None
        self.moment: Moment | None = None
        self.raised: BaseException | None = None
        self.has_left = False
        self.ahead_s: float | None = None
        self._holds = True
        self._now_ns = 0
        self._states: dict[str, ClusterState] = {}
        self._truth: dict[str, Truth] = {}
        self._events: list[Event] = []

    def watch(self, info: Info) -> None:
        """Prepare for the run that `world/info` describes; in realtime, time does not wait for the test."""
        simulated = [drone.name for drone in info.drones if drone.body is UNSET]
        truth = [keys.truth(drone) for drone in simulated]
        self.gate_keys = (*(keys.status(drone.name) for drone in info.drones), *truth)
        self.reads = (*self.gate_keys, keys.cluster_state("*"), keys.EVENT)
        self.bind(info)
        self._holds = info.mode == "lockstep"
        self.ahead_s = (info.command_delay_ns + info.gate_ns) / 1e9 if self._holds else None

    def begin(self, condition: Condition) -> None:
        """Let simulated time pass until a condition is met; the caller must hold `news`."""
        self._events = [event for event in self._events if event.t_ns >= self._now_ns]
        self.moment = self.moment and self.moment._replace(events=())
        self.raised, self.condition = None, condition
        self.news.notify_all()

    def finish(self) -> None:
        """Let simulated time pass until the end of the run."""
        with self.news:
            self.begin(lambda _: False)

    def receive(self, key: str, message: Any) -> None:
        if key == keys.EVENT:
            self._events.append(message)
        elif isinstance(message, ClusterState):
            self._states[keys.thing(key)] = message
        elif isinstance(message, Truth):
            self._truth[keys.thing(key)] = message

    def step(self, t_ns: int) -> Sequence[Output]:
        with self.news:
            self._now_ns = t_ns
            # the events of this gate may be incomplete
            events = tuple(event for event in self._events if event.t_ns < t_ns)
            self.moment = Moment(t_ns / 1e9, dict(self._states), dict(self._truth), events)
            while True:
                condition = self.condition
                if condition is not None:
                    try:
                        if not condition(self.moment):
                            return []
                    except BaseException as error:  # raised again in the test's thread
                        self.raised = error
                    self.condition = None
                self.news.notify_all()
                if not self._holds:
                    return []
                self.news.wait()


def _condition(what: str | float | Condition) -> tuple[Condition, str]:
    """Return the argument of `wait_until` as a function of a moment, with a text that describes it."""
    if callable(what):
        return what, getattr(what, "__name__", repr(what))
    phases = get_args(Phase)
    if isinstance(what, str):
        if what in phases:

            def in_phase(moment: Moment) -> bool:
                return bool(moment.states) and all(state.phase == what for state in moment.states.values())

            return in_phase, f"the phase {what!r}"
        if what not in EVENT_KINDS:
            hint = suggestion(what, (*phases, *EVENT_KINDS))
            rule = f"must be a phase ({', '.join(phases)}), or a kind of event ({', '.join(EVENT_KINDS)})"
            raise RunError(f"wait_until: is {what!r}; {hint}{rule}")
        return lambda moment: any(event.kind == what for event in moment.events), f"an event of kind {what!r}"
    if not isinstance(what, int | float):
        raise RunError(f"wait_until: is {show(what)}; must be a phase, a kind of event, a time [s], or a function")
    return lambda moment: moment.t_s >= what, f"t = {what:g} s"


def _split_program(program: str | Sequence[str]) -> tuple[str, list[str]]:
    """Return the process name of a program (empty if it has none) and the words of its command line."""
    arguments = shlex.split(program) if isinstance(program, str) else list(program)
    if not arguments:
        raise RunError("programs: a command line is empty; must be words such as 'python my_controller.py'")
    name, equals, first = arguments[0].partition("=")
    if equals and "." in name and keys.PROCESS_NAME.fullmatch(name):
        return name, [first, *arguments[1:]]
    return "", arguments


def _reserved_port() -> socket.socket:
    """Return a socket that reserves a free port but still lets a world listen on it."""
    reserved = socket.socket()
    reserved.bind(("127.0.0.1", 0))
    reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # after bind, so that no other socket gets the port
    return reserved
