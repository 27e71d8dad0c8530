"""The central process of a run: the world of a scenario, or a record that is played back in its place."""

import gc
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from zsim.contract import keys
from zsim.errors import RunError, RunFailedError
from zsim.runtime.progress import PERIOD_S, QUIET, HoldReasons, JsonProgress, ProgressSink, Screen, SlowStart
from zsim.runtime.rate_limit import RateLimit
from zsim.scenario import scenario_file
from zsim.scenario.roles import WORLD, expected_processes
from zsim.scenario.scenario import Scenario
from zsim.transport import connection
from zsim.transport.session import check_expression
from zsim.transport.tls import Identity
from zsim.transport.zenoh_settings import hub_files, require_files
from zsim_deploy.roles.stop_channel import StopChannel

if TYPE_CHECKING:
    from zsim_world.run.playback import PlaybackRange

SHOWN_EVENTS = 2000  # maximum number of events shown per run, besides those of VITAL kinds; the record has all events
HEALTH_PERIOD_S = 0.5  # minimum interval between lines about a process's health; the contract says 1 Hz, some send more
VITAL = frozenset({"death", "doubled", "failure", "overdue", "end"})  # kinds of events that are always shown


def world(
    scenario: Scenario,
    mode: str,
    rate: float,
    endpoints: list[str],
    launched: str | None,
    expect: list[str] | None,
    identity: Identity,
    journal: Path | None = None,
    all_died: bool = False,
    changed: Sequence[str] | None = None,
) -> None:
    """Run the world of a scenario on endpoints until the scenario ends or the process is stopped.

    Args:
        rate: pace in simulated seconds per wall second; 0: as fast as possible.
        launched: id of the run, if a launcher started this process; else None.
        expect: names of further processes to wait for.
        journal: folder of the run's journal, from which a restarted world continues; None: no journal.
        all_died: whether all participants are restarted as well when the world continues.
        changed: overrides that the scenario already contains, as values of `--set`.

    Raises:
        RunError: the journal belongs to another run.
        SessionError: an endpoint is in use, or the identity cannot be used.
        RunFailedError: a process left early, and no launcher started the world.
    """
    from zsim.math.compiled import is_kept
    from zsim_world.fleet.kernel import advance
    from zsim_world.run.world import World
    from zsim_world.server.run_journal import RunJournal, journaled_run
    from zsim_world.server.world_process import run

    clients = {*expected_processes(scenario), *(expect or ())}
    require_files(hub_files(len(clients)), f"a world of {len(clients)} processes")
    identity = identity._replace(process=WORLD)
    connection.check_listening(endpoints, identity)  # fails before anything is compiled
    stop = StopChannel(launched, identity)
    text = "compiling the world's kernel; later runs on this machine find it compiled"
    if is_kept(advance):
        text = "loading the world's kernel; this machine is busy"
    slow_start = SlowStart(JsonProgress().say if launched else print, text)
    try:
        run_id = launched or (journaled_run(journal) if journal else None)
        run_world = World(scenario, mode, rate, time.monotonic_ns, run_id, changed)
    finally:
        slow_start.over()
    run_world.is_launched = launched is not None
    for name in expect or ():
        run_world.barrier.expect(name)
    gc.collect()
    gc.freeze()
    sha256 = scenario_file.sha256(scenario_file.to_text(scenario))
    if launched:
        progress = JsonProgress()
        run_journal = RunJournal(journal, run_world.run_id, sha256, progress.say, all_died)
        run(run_world, endpoints, stop.reason, WorldProgress(progress).show, identity=identity, journal=run_journal)
        stop.exit_if_terminated()
        return
    with Screen(scenario.duration_s) as screen:
        listening = f"world of {scenario.federation!r} on {', '.join(endpoints)}; Ctrl-C ends the run"
        run_journal, show = (
            RunJournal(journal, run_world.run_id, sha256, screen.say, all_died),
            WorldProgress(screen).show,
        )
        run(run_world, endpoints, stop.reason, show, lambda: screen.say(listening), identity, run_journal)
        screen.say(f"ended: {run_world.ended}")
    if run_world.left_early:  # for a launched world, the launcher reads this from the record
        raise RunFailedError("; ".join(run_world.left_early))


class WorldProgress:
    """Filters the progress of a run for a sink; the world calls `show` with its clocks, events and so on."""

    def __init__(self, sink: ProgressSink) -> None:
        self._sink = sink
        self._clocks = RateLimit(PERIOD_S)
        self._healths = RateLimit(HEALTH_PERIOD_S)
        self._reasons = HoldReasons()
        self._shown_count = 0
        self._links: dict[str, str] = {}  # link state of each drone

    def show(self, kind: str, message: Any, about: str) -> None:
        sink = self._sink
        if kind == "clock" and (self._clocks.spend() or message.state == "stopped"):
            waiting = [
                {"name": w.name, "host": w.host, "since_wall_s": round(w.since_wall_s, 1), "held_by": w.held_by}
                for w in message.waiting_for
            ]
            clock = {"t_s": message.t_ns / 1e9, "rate": message.rate, "state": message.state}
            sink.clock({**clock, "phase": about, "waiting_for": waiting})
        elif kind == "state" and (line := self._reasons.line(about, message)):
            sink.say(line)
        elif kind == "health" and self._healths.spend(about):
            sink.health({"name": about, "lag_ns": message.lag_ns, "received": message.received})
        elif kind == "link":
            if message.state != self._links.get(about) and self._shown_count < SHOWN_EVENTS:
                self._shown_count += 1
                sink.say(f"  {message.t_ns / 1e9:8.2f} s  link of {about}: {message.state}, {message.peer}")
            self._links[about] = message.state
        elif kind == "resumed":
            sink.say(f"{about}: continues at t = {message / 1e9:.2f} s")
        elif kind == "event":
            is_vital = message.kind in VITAL or message.data.get("fails")
            if is_vital or self._shown_count < SHOWN_EVENTS:
                self._shown_count += message.kind not in QUIET
                event = {name: getattr(message, name) for name in ("kind", "subject", "text")}
                sink.event({"t_s": message.t_ns / 1e9, **event, "data": message.data if is_vital else {}})


class ReplayOptions(NamedTuple):
    """Options for playing a record."""

    choice: "PlaybackRange"  # the part to play
    rate: float  # simulated seconds per wall second; 0: as fast as possible
    expect: tuple[str, ...]  # names of the processes to wait for
    endpoints: tuple[str, ...]  # endpoints to listen on
    federation: str | None = None  # federation to play in; None: the record's


def play(path: Path, options: ReplayOptions, who: Identity) -> None:
    """Play a record until its end, or until the process is stopped.

    `path`: folder of a run, or its run.mcap. Raises RunError or RecordError if there is no record or it has nothing to
    play, and SessionError if an endpoint is in use, a key expression is invalid, or the identity cannot be used.
    """
    from zsim.record.record_reader import record_notes
    from zsim_analysis.reading.recorded_run import open_run
    from zsim_world.run.playback import Playback
    from zsim_world.server.world_process import run

    for expression in options.choice.keys:
        check_expression(expression)
    stop = StopChannel()
    with open_run(path) as (reader, info, scenario):
        for expression in options.choice.keys:
            if not any(keys.matches(expression, key) for key in reader.topics()):
                available = ", ".join(list(reader.topics())[:20])
                raise RunError(f"--keys is {expression!r}; must match a recorded key: {available} …")
        if options.federation is not None:
            federation = keys.name(options.federation, "federation")
            scenario = msgspec.structs.replace(scenario, federation=federation)
        playback = Playback(reader, scenario, info, options.choice, options.rate, time.monotonic_ns)
        for name in options.expect:
            playback.barrier.expect(name)
        last = reader.last(keys.CLOCK)
        last_ns = options.choice.to_ns if last is None else min(last.t_ns, options.choice.to_ns or last.t_ns)
        end_s = scenario.duration_s if last_ns is None else last_ns / 1e9
        with Screen(end_s, from_s=options.choice.from_ns / 1e9) as screen:
            where = f"{scenario.federation!r} on {', '.join(options.endpoints)}"
            text = f"replay of run {info.run_id} as {where}; Ctrl-C ends it"
            show = WorldProgress(screen).show
            run(playback, options.endpoints, stop.reason, show, lambda: screen.say(text), who)
            for note in record_notes(reader):
                screen.say(note)
            screen.say(f"ended: {playback.ended}")
