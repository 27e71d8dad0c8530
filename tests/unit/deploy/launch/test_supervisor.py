"""The supervision of a run's processes, with fakes that end as scripted; signals, and a closed terminal."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from refused import has_terms

from zsim.errors import RunError
from zsim.scenario.scenario import Processes
from zsim_deploy.launch.supervisor import (
    QUIET_WORLD_S,
    RESTARTS_MAX,
    SILENT_S,
    SUPERSEDED,
    UNREAD,
    USER_FAULT,
    DeathPolicy,
    EndSignals,
    Supervisor,
    WorldWatch,
)


class Show:
    """Records the lines shown."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def clock(self, line: dict[str, Any]) -> None: ...
    def event(self, line: dict[str, Any]) -> None: ...
    def health(self, line: dict[str, Any]) -> None: ...

    def say(self, text: str) -> None:
        self.lines.append(text)


class Member:
    """A process that ends with the given exit codes, one per start; with None, it runs until it is stopped."""

    is_program = False

    def __init__(self, name: str, *codes: int | None, lives_for: int = 0) -> None:
        self.name, self.role = name, name.split(".")[0]
        self.restarts, self.pid = 0, 0
        self._codes, self._left, self._lives_for = list(codes), 0, lives_for
        self.code: int | None = None
        self.stopped_for: str | None = None
        self.closed = self.killed = False

    def start(self) -> None:
        self.pid += 1
        self.code = None
        self._next = self._codes.pop(0) if self._codes else None
        self._left = self._lives_for

    def wait(self, timeout_s: float) -> bool:
        self._left -= 1
        if self.stopped_for is not None or (self._next is not None and self._left <= 0):
            self.code = self._next or 0
        return self.code is not None

    def outcome(self) -> str:
        return f"exit code {self.code}"

    def last_log_line(self) -> str:
        return f"{self.name}: last words"

    def request_stop(self, reason: str) -> None:
        self.stopped_for = reason

    def kill(self) -> None:
        self.killed = True
        self.code = -signal.SIGKILL

    def close(self) -> None:
        self.closed = True


class Team:
    """A world, which runs for a number of looks, a recorder, and other processes, which each look advances too."""

    def __init__(self, *others: Member, looks: int = 20, world: Sequence[int] = (0,), **deaths: Any) -> None:
        self.show = Show()
        self.watch = Supervisor(Processes(**deaths), self.show)
        self.world = Member("world", *world, lives_for=looks)
        self.recorder = Member("recorder", 0, lives_for=looks + 1)
        self.others = others
        self.members: list[Any] = [self.world, self.recorder, *others]
        self.watch.members = list(self.members)

    def go(self, look=lambda: None):
        def live() -> None:
            for member in (self.recorder, *self.others):
                member.wait(0.0)
            look()

        return self.watch.run(live)

    def tell(self, kind: str, subject: str = "", text: str = "", **data: Any) -> None:
        """Let the world print an event."""
        event = {"kind": kind, "subject": subject, "text": text, "data": data}
        self.watch.handle_line(json.dumps({"event": event}))


def test_a_run_that_ends_normally_has_not_failed():
    team = Team(Member("estimator.d1"))
    outcome = team.go()
    assert (outcome.failed, outcome.interrupted) == (False, False)
    assert all(member.closed for member in team.members)


def test_a_process_that_outlives_the_run_is_left_to_the_caller():
    console = Member("console.run")
    team = Team(console, Member("estimator.d1"))
    team.watch.survivor = team.others[0]
    team.go()
    assert (console.stopped_for, console.closed, console.code) == (None, False, None)
    assert all(member.closed for member in team.members if member is not console)


@pytest.mark.parametrize("name", ["recorder", "world"])
def test_a_failure_after_the_end_is_the_reason_of_the_failed_run(name: str):
    team = Team(world=(143 if name == "world" else 0,))
    if name == "recorder":
        team.recorder = team.watch.members[1] = Member("recorder", 143, lives_for=21)
    team.tell("end", text="over")
    outcome = team.go()
    assert outcome.failed
    assert has_terms(outcome.reason, name, "143")


# (name, exit codes, settings of the processes, whether the run fails, restarts)
DEATHS: list[tuple[str, list[int], dict[str, Any], bool, int]] = [
    ("estimator.d1", [1], {}, False, 1),
    ("estimator.d1", [USER_FAULT], {}, True, 0),
    ("estimator.d1", [1], {"on_death": {"estimator": "drop"}}, False, 0),
    ("estimator.d1", [1], {"on_death": {"estimator.d1": "end", "estimator": "drop"}}, True, 0),
    ("estimator.d1", [SUPERSEDED], {"on_death": {"estimator": "end"}}, False, 0),
    ("estimator.d1", [0], {"on_death": {"estimator": "end"}}, False, 0),
    ("recorder2", [1], {}, False, 0),
    ("camera.main", [USER_FAULT], {}, False, 0),
    ("camera.main", [1], {"on_death": {"camera": "end"}}, True, 0),
    ("camera.main", [USER_FAULT], {"on_death": {"camera": "end"}}, True, 0),
    ("console.run", [USER_FAULT], {}, False, 0),
    # too many in a row
    ("estimator.d1", [1] * 20, {}, True, RESTARTS_MAX),
    ("estimator.d1", [1] * 20, {"return_s": 1, "on_overdue": {"estimator": "drop"}}, False, RESTARTS_MAX),
    ("camera.main", [1] * 20, {}, False, RESTARTS_MAX),  # no gate waits for a camera
    ("camera.drone1", [1] * 20, {}, False, RESTARTS_MAX),
    ("detector.main", [1] * 20, {}, False, RESTARTS_MAX),
    ("camera.main", [1] * 20, {"return_s": 1, "on_overdue": {"camera": "end"}}, True, RESTARTS_MAX),
    ("camera.d1", [1] * 20, {"expect": ["camera.d1"]}, True, RESTARTS_MAX),  # the run cannot begin without it
    ("world", [-signal.SIGKILL, -signal.SIGKILL, 0], {}, False, 2),
    ("world", [-signal.SIGKILL] * 20, {}, True, RESTARTS_MAX),
    ("world", [USER_FAULT, 0], {}, True, 0),  # the world cannot start
    ("world", [1, 0], {}, True, 0),
]


@pytest.mark.parametrize(("name", "codes", "processes", "fails", "restarts"), DEATHS)
def test_a_death_restarts_drops_or_ends_as_configured(
    name: str, codes: list[int], processes: dict[str, Any], fails: bool, restarts: int
):
    if name == "world":
        team = Team(Member("estimator.d1"), world=codes, looks=1)
    else:
        team = Team(Member(name, *codes), looks=100, **processes)
    outcome = team.go()
    dead = next(member for member in team.members if member.name == name)
    assert (outcome.failed, dead.restarts) == (fails, restarts)
    if len(codes) > RESTARTS_MAX and name != "world":
        assert outcome.reason.startswith(f"{name} ended") == fails
        assert fails or has_terms(team.show.lines[-1], name, "exit code 1", f"{RESTARTS_MAX} restarts", "dropped")
    elif restarts and name != "world":
        assert "on_death: restart" in team.show.lines[0]


def test_a_started_run_continues_without_an_expected_camera():
    team = Team(Member("camera.d1", *[1] * 20), looks=100, expect=["camera.d1"])
    team.watch.handle_line('{"clock": {"state": "running"}}')
    assert not team.go().failed


@pytest.mark.parametrize(
    ("name", "processes", "flies", "action"),
    [
        ("controller.main", {}, True, "end"),
        ("controller.main", {"on_death": {"controller": "restart"}}, True, "end"),
        ("controller.main", {"on_death": {"controller": "drop"}}, True, "drop"),
        ("controller.main", {"on_death": {"controller.main": "wait"}}, True, "wait"),
        (
            "controller.main",
            {"on_death": {"controller": "drop"}},
            False,
            "end",
        ),  # the world waits for it before the run begins
        ("controller.main", {"on_death": {"controller.main": "wait"}}, False, "end"),
        ("camera.main", {}, True, "drop"),
        ("camera.main", {"expect": ["camera.main"]}, True, "drop"),  # the run has begun
        ("camera.main", {"gating": ["camera"]}, True, "end"),
        ("camera.drone1", {"gating": ["camera"]}, True, "end"),
    ],
)
def test_without_a_useful_restart_the_policy_drops_waits_or_ends(
    name: str, processes: dict[str, Any], flies: bool, action: str
):
    """The launcher decides as the world does when a process raises: it does not end a run that the world continues."""
    assert DeathPolicy(Processes(**processes)).decide(name, USER_FAULT, flies).action == action
    policy = DeathPolicy(Processes(gating=["camera"]))
    decisions = [policy.decide("camera.main", 1, flies=True).action for _ in range(RESTARTS_MAX + 1)]
    assert decisions == ["restart"] * RESTARTS_MAX + ["end"]


def test_a_superseded_process_is_restarted_when_its_successor_dies():
    team = Team(Member("estimator.d1", SUPERSEDED, None))

    def look() -> None:
        if team.others[0].code == SUPERSEDED:
            team.tell("death", "estimator.d1", on_death="restart")

    assert not team.go(look).failed
    assert team.others[0].restarts == 1


@pytest.mark.parametrize("codes", [(0, None), (0,) * (RESTARTS_MAX + 2)])
def test_exit_code_0_without_a_goodbye_counts_as_a_death(codes: tuple[int | None, ...]):
    """For example by `os._exit(0)`; too many of them end the run."""
    team = Team(Member("estimator.d1", *codes), looks=60)

    def look() -> None:
        if team.others[0].code == 0:
            team.tell("death", "estimator.d1", on_death="restart", pid=team.others[0].pid)

    outcome = team.go(look)
    assert outcome.failed == (len(codes) > 2)
    assert team.others[0].restarts == min(len(codes) - 1, RESTARTS_MAX)
    assert not outcome.failed or has_terms(outcome.reason, "estimator.d1", "exit code 0")


def test_a_process_is_not_started_twice_for_one_death():
    team = Team(Member("estimator.d1", None))
    team.go(lambda: team.tell("death", "estimator.d1", on_death="restart"))
    assert team.others[0].restarts == 0


@pytest.mark.parametrize(("action", "fails"), [("drop", False), ("end", True)])
def test_an_overdue_process_is_dropped_or_ends_the_run(action: str, fails: bool):
    team = Team(Member("estimator.d1"))
    outcome = team.go(lambda: team.tell("overdue", "estimator.d1", "late", on_overdue=action))
    assert outcome.failed == fails
    assert team.others[0].killed is not fails


def test_deaths_far_apart_do_not_accumulate(monkeypatch):
    now = iter(range(0, 100_000, 100))
    monkeypatch.setattr("zsim_deploy.launch.supervisor.time.monotonic", lambda: float(next(now)))
    team = Team(Member("estimator.d1", *[1] * 8, None), looks=12)
    assert not team.go().failed
    assert team.others[0].restarts == 8


def test_a_dead_world_fails_the_run_and_stops_the_rest():
    team = Team(Member("estimator.d1"), world=[-signal.SIGKILL], on_death={"world": "end"})
    outcome = team.go()
    assert outcome.failed
    assert has_terms(outcome.reason, "world", "died", "code -9")
    assert team.others[0].stopped_for == outcome.reason


def test_an_interrupt_stops_every_process():
    team = Team(Member("estimator.d1"), looks=1000)
    outcome = team.go(lambda: team.watch.interrupt("down"))
    assert outcome.interrupted
    assert {member.stopped_for for member in team.members} == {"down"}


def test_a_process_replaces_another():
    old, new = Member("estimator.d1", SUPERSEDED, lives_for=1000), Member("estimator.d1")
    team = Team(old)
    team.watch.submit(lambda: team.watch.replace(new))
    assert not team.go().failed
    assert new.restarts == 1
    assert old.closed
    assert new.closed
    assert new in team.watch.members


def test_the_second_of_two_simultaneous_replacements_is_refused():
    first, second = Member("estimator.d1"), Member("estimator.d1")
    team = Team(Member("estimator.d1", SUPERSEDED, lives_for=1000))
    orders = [team.watch.submit(lambda new=new: team.watch.replace(new)) for new in (first, second)]
    assert not team.go().failed
    assert orders[0].exception() is None
    assert isinstance(orders[1].exception(), RunError)
    assert has_terms(str(orders[1].exception()), "being replaced")
    assert (first.pid, second.pid) == (1, 0)


def test_a_later_replacement_replaces_the_earlier_one():
    first, second = Member("estimator.d1", SUPERSEDED, lives_for=2), Member("estimator.d1")
    old = Member("estimator.d1", SUPERSEDED, lives_for=1)
    team = Team(old, looks=40)
    news = iter((first, second))

    def look() -> None:
        for member in (old, first):
            if member.pid:
                member.wait(0.0)
        if team.watch.members[-1].code is not None or team.watch.members[-1] is old:
            new = next(news, None)
            team.watch.submit(lambda: team.watch.replace(new)) if new else None

    assert not team.go(look).failed
    assert second in team.watch.members
    assert second.restarts == 2


def test_a_failed_order_is_reported_to_its_caller_and_the_run_continues():
    team = Team(Member("estimator.d1"))
    outcome = team.watch.submit(lambda: [].index(1))
    assert not team.go().failed
    assert isinstance(outcome.exception(), ValueError)


def test_an_order_that_comes_too_late_is_cancelled():
    team = Team(Member("estimator.d1"))
    done = []
    late = []
    team.recorder.request_stop = team.others[0].request_stop = lambda reason: late.append(
        team.watch.submit(lambda: done.append(1))
    )  # type: ignore[method-assign]
    team.go(lambda: team.watch.interrupt("ended by zsim down"))
    assert late
    assert all(order.cancelled() for order in late)
    assert not done


def test_a_process_that_does_not_yield_to_its_successor_is_killed(monkeypatch):
    monkeypatch.setattr("zsim_deploy.launch.supervisor.TAKE_OVER_S", -1.0)
    old, new = Member("estimator.d1", lives_for=1000), Member("estimator.d1")
    team = Team(old)
    team.watch.submit(lambda: team.watch.replace(new))
    assert not team.go().failed
    assert old.code == -signal.SIGKILL
    assert has_terms(team.show.lines[0], "estimator.d1", "pid 1")


def test_a_process_waiting_for_its_host_is_killed_when_replaced():
    old, new = Member("estimator.d1"), Member("estimator.d1")
    old.start = lambda: None  # type: ignore[method-assign]
    old.wait = lambda timeout_s: False  # type: ignore[method-assign]
    team = Team(old)
    team.watch.submit(lambda: team.watch.replace(new))
    team.go()
    assert old.code == -signal.SIGKILL


def test_all_processes_are_closed_concurrently():
    """Each close waits for all the others."""
    together = threading.Barrier(4, timeout=120.0)

    class Slow(Member):
        def close(self) -> None:
            together.wait()
            super().close()

    team = Team(Slow("estimator.d1"), Slow("estimator.d2"), Slow("estimator.d3"), Slow("estimator.d4"))
    team.go()
    assert all(member.closed for member in team.members)


def test_a_run_interrupted_before_its_start_starts_no_process():
    team = Team(Member("estimator.d1"))
    team.watch.interrupt("down")
    outcome = team.go()
    assert (outcome.reason, outcome.interrupted) == ("down", True)
    assert {member.pid for member in team.members} == {0}


@pytest.mark.parametrize("text", ["1234\n", "[1]\n", "null\n", "Welcome\n"])
def test_lines_that_are_not_progress_are_ignored(text):
    team = Team()
    team.watch.handle_line(text)
    assert team.show.lines == []


@pytest.mark.parametrize("begins", [False, True])
def test_a_world_that_does_not_start_is_reported_once(monkeypatch: pytest.MonkeyPatch, begins: bool):
    wall_s = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: wall_s[0])
    team = Team(looks=5)

    def look() -> None:
        wall_s[0] += SILENT_S
        if begins:
            team.watch.handle_line('{"clock": {}}')

    team.go(look)
    named = [line for line in team.show.lines if has_terms(line, "world", "world: last words")]
    assert len(named) == (0 if begins else 1)


def test_a_stopped_world_is_reported_once_and_again_when_it_returns():
    watch = WorldWatch()
    assert watch.change(100.0, 7) is None  # it may still be compiling
    watch.last_s = 100.0
    assert watch.change(100.0 + 0.9 * QUIET_WORLD_S, 7) is None
    assert has_terms(watch.change(102.0, 7) or "", "world", "2.0 s", "stopped")
    assert watch.change(110.0, 7) is None
    watch.last_s = 110.0
    assert has_terms(watch.change(110.1, 7) or "", "world", "back")
    assert watch.change(110.2, 7) is None


def test_an_ending_world_is_not_reported_as_waiting_for_a_process():
    watch = WorldWatch()
    watch.last_s = 100.0
    watch.clock({"state": "running", "waiting_for": [{"name": "estimator.d1"}]})
    watch.clock({"state": "stopped", "waiting_for": [{"name": "recorder"}]})
    text = watch.change(102.0, 7) or ""
    assert has_terms(text, "world", "ended", "recorder")
    assert "kill" not in text


TALKS = """
import signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whoever runs the tests may be under nohup
from pathlib import Path
from zsim_deploy.launch.supervisor import UNREAD, EndSignals
told = []
with EndSignals(Path(sys.argv[1]), lambda: told.append(1)):
    print("ready", flush=True)
    while not told:
        sys.stdin.readline()
    print("fetching", flush=True)
    print("ended", file=sys.stderr, flush=True)
"""


def test_after_the_terminal_is_lost_output_goes_to_a_file(tmp_path: Path) -> None:
    master, slave = os.openpty()
    command = [sys.executable, "-c", TALKS, str(tmp_path / "up.log")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=slave, stderr=slave, start_new_session=True) as talker:
        os.close(slave)
        output = b""
        while not output.endswith(b"\n"):  # output may arrive in parts
            output += os.read(master, 100)
        assert output.strip() == b"ready"
        os.close(master)
        for _ in range(2):  # one from the system, one from the shell
            talker.send_signal(signal.SIGHUP)
        talker.communicate(b"\n", timeout=60.0)
    assert talker.returncode == 0
    assert (tmp_path / "up.log").read_text().splitlines() == ["fetching", "ended"]


def test_a_terminal_that_still_exists_shows_where_output_continues(tmp_path: Path) -> None:
    """Nothing but that line is written there, because the reader of a pipe may be gone a moment later."""
    log = tmp_path / "up.log"
    command = [sys.executable, "-c", TALKS, str(log)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True) as talker:  # type: ignore[call-overload]
        assert talker.stdout
        assert talker.stdout.readline() == "ready\n"
        talker.send_signal(signal.SIGHUP)
        output, complained = talker.communicate("\n", timeout=60.0)
    assert output == ""
    assert has_terms(complained, "terminal", "closed", str(log))
    assert log.read_text().splitlines() == ["fetching", "ended"]


def test_output_that_cannot_be_kept_is_said_to_be_lost(tmp_path: Path) -> None:
    log = tmp_path / "missing" / "up.log"
    with subprocess.Popen(
        [sys.executable, "-c", TALKS, str(log)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as talker:
        assert talker.stdout
        assert talker.stdout.readline() == "ready\n"
        talker.send_signal(signal.SIGHUP)
        output, complained = talker.communicate("\n", timeout=60.0)
    assert (talker.returncode, output) == (0, "")
    assert has_terms(complained, "output is lost", str(log), os.strerror(errno.ENOENT))
    assert "goes to" not in complained


LOOKS = """
import sys
from pathlib import Path
from zsim_deploy.launch.supervisor import UNREAD, EndSignals
told = []
with EndSignals(Path(sys.argv[1]), lambda: told.append(1)) as signals:
    print("ready", flush=True)
    while not signals.reason:
        signals.look()
    print(signals.reason, flush=True)
    print("fetching", len(told), flush=True)
"""


@pytest.mark.parametrize("both", [False, True], ids=["stdout", "both"])
def test_a_closed_output_pipe_is_noticed_without_writing(tmp_path: Path, both: bool) -> None:
    log = tmp_path / "up.log"
    read, write = os.pipe()
    errors = write if both else subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", LOOKS, str(log)], stdout=write, stderr=errors) as talker:
        os.close(write)
        with os.fdopen(read) as reader:
            assert reader.readline() == "ready\n"
        complained = talker.communicate(timeout=60.0)[1]
    assert talker.returncode == 0
    assert log.read_text().splitlines() == [
        UNREAD,
        f"fetching {int(both)}",
    ]  # the callback runs only once standard error, where the screen is, is closed too
    assert both or has_terms(complained.decode(), UNREAD, str(log))


def test_a_broken_pipe_gives_the_exit_code_of_shells(tmp_path: Path) -> None:
    """Click alone would exit with 1, without a message."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "zsim_deploy.cli", "validate", "scenarios/step.yaml"]
    done = subprocess.run(
        command, stdout=write, stderr=subprocess.PIPE, timeout=60.0, check=False, cwd=Path(__file__).parents[4]
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (141, b"")


def test_under_nohup_sighup_is_ignored(tmp_path: Path) -> None:
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with EndSignals(tmp_path / "up.log", lambda: pytest.fail("hung up")):
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, former)


def test_sigterm_acts_like_ctrl_c(tmp_path: Path) -> None:
    former = signal.getsignal(signal.SIGTERM)
    with EndSignals(tmp_path / "up.log", lambda: None), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is former
