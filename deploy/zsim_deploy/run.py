"""A whole run: every process of a scenario started, watched, recorded, ended, and reported."""

import contextlib
import json
import signal
import socket
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from zsim import scenario_file
from zsim.errors import RecordError, RunError
from zsim.record import repair
from zsim.scenario import Scenario
from zsim_deploy.child import Child
from zsim_deploy.leash import Leash
from zsim_deploy.progress import Screen

DEFAULT_PORT = 7447  # Zenoh's own
POLL_S = 0.05  # how often the children are looked at
END_S = 8.0  # after the world has ended, how long the others may take; the recorder may have a disk to wait for
WORLD_FIRST_S = 1.0  # after Ctrl-C, how long the world has to end the run for everybody
INTERRUPT_S = 2.5  # after Ctrl-C, how long anybody may take; the whole is promised within 3 s
RESTARTS_MAX = 5  # of one role within RESTART_WINDOW_S; more is a fault that a restart does not heal
RESTART_WINDOW_S = 20.0
USER_FAULT = 2  # exit code of a role that refuses its arguments or cannot run at all
SUPERSEDED = 3  # exit code of a role whose place another process of its name has taken


@dataclass
class Options:
    """How to run a scenario."""

    scenario: Scenario
    out: Path
    mode: str = "lockstep"
    rate: float = 0.0
    listen: str | None = None
    order: list[str] = field(default_factory=list)


@dataclass
class Outcome:
    """How a run ended."""

    reason: str
    failed: bool = False
    interrupted: bool = False


class Run:
    """One run as processes on this machine."""

    def __init__(self, options: Options, screen: Screen) -> None:
        self._options = options
        self._screen = screen
        self._endpoint = options.listen or f"tcp/127.0.0.1:{free_port(screen)}"
        self._logs = options.out / "logs"
        self._logs.mkdir(parents=True)
        self._file = options.out / "scenario.yaml"
        self._file.write_text(scenario_file.to_text(options.scenario))
        self._reason = ""
        self._failed = False
        self._interrupted: str | None = None
        self._until_s: float | None = None
        self._dead: set[str] = set()
        self._children = self._make_children()

    def go(self) -> Outcome:
        """Start everything, watch it to its end, leave nothing behind."""
        with self._interrupts():
            try:
                for child in self._children:
                    child.start()
                self._watch()
                self._finish()
            finally:
                for child in self._children:
                    child.close()
        return Outcome(self._reason or "ended", self._failed, self._interrupted is not None)

    def _make_children(self) -> list[Child]:
        scenario, federation = self._options.scenario, self._options.scenario.federation
        # Another run's world may listen where ours could not: nobody of this run is to join that one.
        launched = ["--launched", uuid.uuid4().hex[:12]]
        reach = ["--connect", self._endpoint, "--federation", federation, *launched]
        pace = ["--realtime"] if self._options.mode == "realtime" else []
        pace += ["--rate", str(self._options.rate)] if self._options.rate else []
        world = ["world", str(self._file), "--listen", self._endpoint, "--expect", "recorder", *pace, *launched]
        record = ["record", "--out", str(self._options.out), *reach]
        children = [Child("world", world, self._logs, self._on_line), Child("recorder", record, self._logs)]
        for drone in scenario.drones:
            children.append(Child(f"estimator.{drone.name}", ["estimator", drone.name, *reach], self._logs))
        for cluster in scenario.clusters:
            children.append(Child(f"controller.{cluster.name}", ["controller", cluster.name, *reach], self._logs))
        wanted = scenario.processes.expect
        if wanted is not None:
            children = [c for c in children if c.role in ("world", "recorder") or c.name in wanted]
        rank = {name: i for i, name in enumerate(self._options.order)}
        return sorted(children, key=lambda child: rank.get(child.name, len(rank)))

    @contextlib.contextmanager
    def _interrupts(self) -> Any:
        """Take Ctrl-C and SIGTERM as a wish to end the run well; a second Ctrl-C does not wait."""

        def on_signal(number: int, _: object) -> None:
            if self._interrupted:
                raise KeyboardInterrupt
            self._interrupted = "interrupted by Ctrl-C" if number == signal.SIGINT else "terminated"

        former = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)

    def _on_line(self, text: str) -> None:
        """Take a line of the world's progress."""
        try:
            line = json.loads(text)
        except ValueError:
            return  # not progress: something printed by a library
        if "clock" in line:
            self._screen.clock(line["clock"])
        elif "event" in line:
            self._on_event(line["event"])
        elif "say" in line:
            self._screen.say(line["say"])

    def _on_event(self, event: dict[str, Any]) -> None:
        self._screen.event(event)
        if event["kind"] == "end":
            self._reason = self._reason or event["text"]
        elif event["kind"] == "death" and event["data"].get("on_death") == "end":
            self._fail(f"{event['subject']} died")

    # Watching

    def _watch(self) -> None:
        """Return when the world has ended, or when it has to."""
        world = next(child for child in self._children if child.role == "world")
        while world.code is None:
            if self._interrupted:
                self._reason = self._interrupted
                world.tell_stop(self._reason)
                world.wait(min(WORLD_FIRST_S, self._left_s()))
                return
            for child in self._children:
                if child is not world and child.code is not None and child.name not in self._dead:
                    self._on_exit(child, world)
            world.wait(POLL_S)
        if world.code != 0:
            self._fail(f"the world died: {world.outcome()}")

    def _on_exit(self, child: Child, world: Child) -> None:
        """Do what on_death says of a role that ended while the world runs."""
        if child.code in (0, SUPERSEDED):
            self._dead.add(child.name)
            if child.code == SUPERSEDED:
                self._screen.say(child.last_words())
            return
        what = self._on_death(child)
        if child.code == USER_FAULT or (what == "restart" and self._too_often(child)):
            what = "end"
        self._screen.say(f"{child.name} (pid {child.pid}) ended: {child.outcome()}; on_death: {what}")
        if what == "restart":
            child.restarts += 1
            child.start()
            return
        self._dead.add(child.name)
        if what == "end":
            self._fail(f"{child.name} ended: {child.outcome()}")
            world.tell_stop(self._reason)

    def _on_death(self, child: Child) -> str:
        given = self._options.scenario.processes.on_death
        default = {"estimator": "restart", "controller": "restart", "recorder": "end"}.get(child.role, "drop")
        return given.get(child.name) or given.get(child.role) or default

    @staticmethod
    def _too_often(child: Child) -> bool:
        return child.restarts >= RESTARTS_MAX and time.monotonic() - child.started_s < RESTART_WINDOW_S

    def _fail(self, reason: str) -> None:
        self._reason, self._failed = self._reason or reason, True

    def _finish(self) -> None:
        """Let everybody leave; the recorder leaves last, by itself."""
        for child in self._children:
            if self._failed or self._interrupted or child.role != "recorder":
                child.tell_stop(self._reason)
        for child in self._children:
            while not child.wait(min(POLL_S, self._left_s())) and self._left_s() > 0:
                continue
        recorder = next(child for child in self._children if child.role == "recorder")
        if recorder.code not in (0, None) and recorder.name not in self._dead:
            self._fail(f"the recorder ended: {recorder.outcome()}")

    def _left_s(self) -> float:
        """Return how long the others may still take, now that the run is to end; Ctrl-C makes it shorter."""
        now_s = time.monotonic()
        latest_s = now_s + (INTERRUPT_S if self._interrupted else END_S)
        self._until_s = latest_s if self._until_s is None else min(self._until_s, latest_s)
        return max(0.0, self._until_s - now_s)


def free_port(screen: Screen) -> int:
    """Return Zenoh's port, or another free one, and say so, where that is taken."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", DEFAULT_PORT))
            return DEFAULT_PORT
        except OSError:
            pass
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    screen.say(f"port {DEFAULT_PORT} is in use; this run is on tcp/127.0.0.1:{port} (--connect for other commands)")
    return port


def make_directory(out: Path | None, scenario: Scenario) -> Path:
    """Return the run's folder, made new.

    Raises:
        RunError: it holds a record already, or cannot be made.
    """
    folder = out or _fresh(Path("runs") / f"{scenario.name}-{time.strftime('%Y%m%d-%H%M%S')}")
    if (folder / "run.mcap").exists() or (folder / "logs").exists():
        raise RunError(f"{folder}: holds a run already; give --out another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{folder}: cannot be made ({error.strerror}); give --out another folder") from error
    return folder


def _fresh(folder: Path) -> Path:
    """Return a folder that is not there yet: two runs may start within one second."""
    names = [folder, *(folder.with_name(f"{folder.name}-{i}") for i in range(2, 1000))]
    return next(name for name in names if not name.exists())


def run_processes(options: Options, screen: Screen) -> Outcome:
    """Run a scenario as real processes; the record is finished whatever happens."""
    scenario = options.scenario
    screen.say(f"{scenario.name}: {len(scenario.drones)} drones, {scenario.duration_s:g} s, into {options.out}")
    outcome = Run(options, screen).go()
    with contextlib.suppress(RecordError):
        repair(options.out / "run.mcap")
    return outcome


def run_in_process(options: Options, screen: Screen) -> Outcome:
    """Run a scenario in this process: the same bits, without Zenoh."""
    from zsim_deploy.in_process import fly

    leash = Leash(launched=False)
    options.out.joinpath("scenario.yaml").write_text(scenario_file.to_text(options.scenario))
    reason = fly(options.scenario, options.out / "run.mcap", leash.reason, screen)
    return Outcome(reason, interrupted=leash.pulled())
