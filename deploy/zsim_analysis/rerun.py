"""`zsim rerun`: the run of a record flown again from its own inputs, and compared with the truth on record.

First its world and its agents, with the inputs of others (operators, users' programs) from the record. Where truth
differs, or the agents cannot be run again, the world alone, with all commands from the record: if that gives the
recorded truth, the difference came from the agents.
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
from zsim.runtime.progress import PERIOD_S, Screen
from zsim.runtime.rate_limit import RateLimit
from zsim.scenario.fault_check import listed
from zsim.schema import plugin
from zsim_analysis.reading.recorded_run import GateInputs, RecordedAgents, RecordedRun, gates, open_run, recorded_agents
from zsim_analysis.rerun_bus import RerunBus, TruthComparison
from zsim_world.run.world import World

Say = Callable[[str], None]
RecordState = Literal["whole", "cut", "damaged"]


class RerunResult(NamedTuple):
    """The result of flying a run again.

    Attributes:
        compared: with the truth on record.
        sha256: of what was result.
        until: why the comparison ended before the record, empty if it did not.
        refused: requests that were carried out on record and are refused now.
        first_output: the first output of an agent that differs, empty if none does.
        failure: of a user's code, empty if none failed.
    """

    compared: TruthComparison
    sha256: str
    until: str
    refused: list[str]
    first_output: str
    failure: str


def rerun_record(place: Path, commands_only: bool, say: Say, note: Say) -> str:
    """Fly the run of a record again; return why truth is not the same, empty if it is, to the bit.

    Args:
        place: folder of the run, or its record.
        commands_only: run no agents.
        say: called with each line of the results.
        note: called with each warning.

    Raises:
        RunError, RecordError: there is no record, or it is not one from the start of a flight.
    """
    with open_run(place) as record:
        if record.info.replay_of:
            raise RunError(f"{place}: is the record of a replay; rerun that of run {record.info.replay_of}")
        if not plugin.may_import() and (names := record.scenario.own_code()):
            reason = f"its scenario names {listed(names)}: code that a rerun runs, and only with --trust"
            raise RunError(f"{place}: {reason}")
        if external := record.scenario.external():
            reason = f"has drones whose bodies are external ({listed(external)}); they cannot be flown again"
            raise RunError(f"{place}: {reason}")
        agents = recorded_agents(record.reader, record.info, record.scenario)
        _warn(record.info, agents, note)
        if commands_only or agents.why_not:
            why = "as asked" if commands_only else agents.why_not
            say(f"agents are not run again: {why}; the world alone, with all recorded commands")
            return _judge(agents.truth_sha256, _fly(record, _without_agents(agents)), _state(record.reader), say)
        say(f"run again: world, {', '.join(map(str, agents.processes))}")
        again = _fly(record, agents)
        fault = _judge(agents.truth_sha256, again, _state(record.reader), say)
        if not fault and (agents.failure or again.failure):
            fault = _judge_failure(agents.failure, again.failure, say)
        if again.compared.first is not None:
            _find_cause(again.first_output, _fly(record, _without_agents(agents)), say)
        return fault


def _judge_failure(recorded: str, failure: str, say: Say) -> str:
    """Print whether a user's code that ended the run has failed again; return why it has not, empty if it has."""
    if failure == recorded:
        say(f"ended as on record: {failure}")
        return ""
    say(f"on record {recorded or 'no class of a user failed'}")
    return f"flown again, {failure or 'it does not fail'}"


def _without_agents(agents: RecordedAgents) -> RecordedAgents:
    return agents._replace(processes=(), requests=(), failure="")


def _warn(info: messages.Info, agents: RecordedAgents, note: Say) -> None:
    here = fingerprint()
    if {info.fingerprint, *agents.fingerprints} != {here}:
        others = ", ".join(sorted({info.fingerprint, *agents.fingerprints} - {here}))
        note(f"recorded with another numeric fingerprint ({others}; here {here}): the same bits are not promised")
    if info.version != __version__:
        note(f"recorded by zsim {info.version}, flown again by {__version__}: the same bits are not promised")


def _fly(record: RecordedRun, agents: RecordedAgents) -> RerunResult:
    """Fly from gate to gate of a record, as far as it is whole."""
    reader, info, scenario = record
    world = World(scenario, info.mode, 0.0, time.monotonic_ns, info.run_id)
    bus = RerunBus(world, agents, info, scenario)
    compared = TruthComparison(world.names)
    bus.join()
    until = ""
    with _progress(scenario.duration_s, "world and agents" if agents.processes else "world alone") as show:
        due_ns = 0
        for gate in gates(reader, world.names):
            until = _fault(gate, due_ns, world.names)
            if until:
                break
            bus.fly_to(gate)
            compared.add(gate.t_ns, gate.truth, bus.truth)
            due_ns += world.clock.gate_ns
            show(gate.t_ns)
    if agents.failure and not bus.failure:
        bus.answer_last()
    if not compared.instants:
        raise RecordError(f"{reader.path}: {until or 'holds no truth'}; a run is flown again from its start")
    return RerunResult(compared, world.result()["truth_sha256"], until, bus.refused, bus.outputs.first, bus.failure)


def _fault(gate: GateInputs, due_ns: int, names: list[str]) -> str:
    """Return why the next gate of a record cannot be flown, empty if it can."""
    if gate.t_ns != due_ns:
        return f"the record has nothing of {due_ns / 1e9:.2f} s"
    missing = [name for name in names if name not in gate.truth]
    return f"the record has no truth of {missing[0]} at {due_ns / 1e9:.2f} s" if missing else ""


@contextmanager
def _progress(duration_s: float, what: str) -> Iterator[Callable[[int], None]]:
    """Yield a function that shows progress at an instant."""
    throttle, start_s = RateLimit(PERIOD_S), time.monotonic()
    with Screen(duration_s) as screen:

        def show(t_ns: int) -> None:
            if throttle.spend():
                rate = t_ns / 1e9 / max(1e-9, time.monotonic() - start_s)
                screen.clock({"t_s": t_ns / 1e9, "rate": rate, "state": what, "phase": "", "waiting_for": []})

        yield show


def _state(reader: RecordReader) -> RecordState:
    """Return the state of a record, as far as it was read."""
    if reader.damaged:
        return "damaged"
    return "whole" if reader.complete else "cut"


def _judge(recorded: str | None, result: RerunResult, state: RecordState, say: Say) -> str:
    """Print how truth compares; return why it is not the same, empty if it is at all instants of a sound record."""
    compared = result.compared
    for refusal in result.refused:
        say(f"was done on record, and is refused now: {refusal}")
    if compared.first is None:
        return _judge_same(recorded, result, state, say)
    say(f"truth differs: first {compared.first}")
    say(f"               last  {compared.last}; {compared.instants} instants compared")
    if state == "damaged":
        say("the record is damaged: what it lacks may be the difference")
    return f"truth differs, first {compared.first}"


def _judge_same(recorded: str | None, result: RerunResult, state: RecordState, say: Say) -> str:
    """Print how far truth was compared, no instant of which differs; return why not to the end, empty if it was."""
    if recorded == result.sha256 and not result.until:
        say(f"truth_sha256 is the same: {result.sha256}")
        return ""
    reason = _end_of(recorded, result.until, state)
    say(f"{reason}; truth is the same at all {result.compared.instants} instants before, to the bit")
    return "" if recorded is None and not result.until and state != "damaged" else reason


def _end_of(recorded: str | None, until: str, state: RecordState) -> str:
    """Return why truth was compared no further."""
    condition = {"damaged": "is damaged", "cut": "was cut", "whole": "does not hold the whole run"}[state]
    if until:
        return f"{until}, for it {condition}"
    return f"the record {condition} and " + (f"{recorded} cannot be shown" if recorded else "has no truth_sha256")


def _find_cause(first_output: str, alone: RerunResult, say: Say) -> None:
    """Print whether the world or the agents made the difference."""
    if alone.compared.first is None:
        say("the world alone, with all recorded commands, gives the recorded truth: the agents answer differently")
        if first_output:
            say(f"the first answer that differs is {first_output}")
    else:
        say(f"the world alone, with all recorded commands, differs too: first {alone.compared.first}")
