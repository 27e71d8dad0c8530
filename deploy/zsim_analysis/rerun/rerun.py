"""`zsim rerun`: the run of a record flown again from its own inputs, and held against the truth on record.

First its world and its agents, with what came from elsewhere (operators, others' programs) off the record. Where
truth differs, or the agents cannot be run again, the world alone, with all commands off the record: if that gives
the recorded truth, the difference came from the agents.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, NamedTuple

from zsim import __version__
from zsim.contract import messages
from zsim.contract.fingerprint import fingerprint
from zsim.errors import RecordError, RunError
from zsim.record import RecordReader
from zsim.runtime.progress import Screen, Throttle
from zsim_analysis.reading.recorded_run import Opened, opened
from zsim_analysis.rerun.participants import Cast, cast_of
from zsim_analysis.rerun.recorded_inputs import Passage, passages
from zsim_analysis.rerun.rerun_bus import RerunBus
from zsim_analysis.rerun.truth_comparison import Comparison
from zsim_world.flight.world import World

Say = Callable[[str], None]
State = Literal["whole", "cut", "damaged"]  # of a record


class Flown(NamedTuple):
    """What came of flying again.

    Attributes:
        compared: with the truth on record.
        sha256: of what was flown.
        until: why it was compared no further, empty for the end of the record.
        refused: requests that were done on record and are refused now.
        parted: the first answer of an agent that differs, empty where none does.
    """

    compared: Comparison
    sha256: str
    until: str
    refused: list[str]
    parted: str


def rerun_record(place: Path, commands_only: bool, say: Say, note: Say) -> bool:
    """Fly the run of a record again; return whether truth is the same, to the bit.

    Args:
        place: folder of the run, or its record.
        commands_only: run no agents.
        say: told the results.
        note: told what a person should know beside.

    Raises:
        RunError, RecordError: there is no record, or it is not one from the start of a flight.
    """
    with opened(place) as record:
        if record.info.replay_of:
            raise RunError(f"{place}: is the record of a replay; rerun that of run {record.info.replay_of}")
        cast = cast_of(record.reader, record.info, record.scenario)
        _warn(record.info, cast, note)
        if commands_only or cast.why_not:
            why = "as asked" if commands_only else cast.why_not
            say(f"agents are not run again: {why}; the world alone, with all recorded commands")
            return _judge(cast.truth_sha256, _fly(record, _nobody(cast)), _state(record.reader), say)
        say(f"run again: world, {', '.join(map(str, cast.teams))}")
        again = _fly(record, cast)
        same = _judge(cast.truth_sha256, again, _state(record.reader), say)
        if again.compared.first is not None:
            _find_cause(again.parted, _fly(record, _nobody(cast)), say)
        return same


def _nobody(cast: Cast) -> Cast:
    return cast._replace(teams=(), requests=())


def _warn(info: messages.Info, cast: Cast, note: Say) -> None:
    here = fingerprint()
    if {info.fingerprint, *cast.fingerprints} != {here}:
        there = ", ".join(sorted({info.fingerprint, *cast.fingerprints} - {here}))
        note(f"recorded with another numeric fingerprint ({there}; here {here}): the same bits are not promised")
    if info.version != __version__:
        note(f"recorded by zsim {info.version}, flown again by {__version__}: the same bits are not promised")


def _fly(record: Opened, cast: Cast) -> Flown:
    """Fly along a record, as far as it is whole."""
    reader, info, scenario = record
    world = World(scenario, info.mode, 0.0, time.monotonic_ns, info.run_id)
    bus = RerunBus(world, cast, info, scenario)
    compared = Comparison(world.names)
    bus.join()
    until = ""
    with _progress(scenario.duration_s, "world and agents" if cast.teams else "world alone") as show:
        due_ns = 0
        for passage in passages(reader, world.names):
            until = _fault(passage, due_ns, world.names)
            if until:
                break
            bus.pass_on(passage)
            compared.take(passage.t_ns, passage.truth, bus.truth)
            due_ns += world.clock.gate_ns
            show(passage.t_ns)
    if not compared.instants:
        raise RecordError(f"{reader.path}: {until or 'holds no truth'}; a run is flown again from its start")
    return Flown(compared, world.result()["truth_sha256"], until, bus.refused, bus.answers.first)


def _fault(passage: Passage, due_ns: int, names: list[str]) -> str:
    """Return what is wrong with the next gate of a record."""
    if passage.t_ns != due_ns:
        return f"the record has nothing of {due_ns / 1e9:.2f} s"
    lacking = [name for name in names if name not in passage.truth]
    return f"the record has no truth of {lacking[0]} at {due_ns / 1e9:.2f} s" if lacking else ""


@contextmanager
def _progress(duration_s: float, what: str) -> Iterator[Callable[[int], None]]:
    """Yield what shows how far it has come."""
    throttle, start_s = Throttle(), time.monotonic()
    with Screen(duration_s) as screen:

        def show(t_ns: int) -> None:
            if throttle.passes():
                rate = t_ns / 1e9 / max(1e-9, time.monotonic() - start_s)
                screen.clock({"t_s": t_ns / 1e9, "rate": rate, "state": what, "phase": "", "waiting_for": []})

        yield show


def _state(reader: RecordReader) -> State:
    """Return how whole a record is, as far as it was read."""
    if reader.damaged:
        return "damaged"
    return "whole" if reader.complete else "cut"


def _judge(recorded: str | None, flown: Flown, state: State, say: Say) -> bool:
    """Say how truth compares; return whether it is the same, at all instants of a record that is not damaged."""
    compared = flown.compared
    for refusal in flown.refused:
        say(f"was done on record, and is refused now: {refusal}")
    if compared.first is None:
        return _judge_same(recorded, flown, state, say)
    say(f"truth differs: first {compared.first}")
    say(f"               last  {compared.last}; {compared.instants} instants compared")
    if state == "damaged":
        say("the record is damaged: what it lacks may be the difference")
    return False


def _judge_same(recorded: str | None, flown: Flown, state: State, say: Say) -> bool:
    """Say how far truth was compared, of which no instant differs; return whether more cannot be asked for."""
    if recorded == flown.sha256 and not flown.until:
        say(f"truth_sha256 is the same: {flown.sha256}")
        return True
    why = _end_of(recorded, flown.until, state)
    say(f"{why}; truth is the same at all {flown.compared.instants} instants before, to the bit")
    return recorded is None and not flown.until and state != "damaged"


def _end_of(recorded: str | None, until: str, state: State) -> str:
    """Return why truth was compared no further."""
    flaw = {"damaged": "is damaged", "cut": "was cut", "whole": "does not hold the whole run"}[state]
    if until:
        return f"{until}, for it {flaw}"
    return f"the record {flaw} and " + (f"{recorded} cannot be shown" if recorded else "has no truth_sha256")


def _find_cause(parted: str, alone: Flown, say: Say) -> None:
    """Say whether the world or the agents made the difference."""
    if alone.compared.first is None:
        say("the world alone, with all recorded commands, gives the recorded truth: the agents answer differently")
        if parted:
            say(f"the first answer that differs is {parted}")
    else:
        say(f"the world alone, with all recorded commands, differs too: first {alone.compared.first}")
