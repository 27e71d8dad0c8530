"""A record played back onto the keys by a process that stands in for the world."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from zsim.contract import keys
from zsim.errors import RunError
from zsim.record import RecordReader
from zsim.record.run_folder import record_notes
from zsim.runtime.progress import Screen
from zsim.transport import session
from zsim.transport.tls import Identity
from zsim_analysis.reading.recorded_run import opened
from zsim_deploy.roles.roles import told
from zsim_deploy.roles.stop_channel import Leash
from zsim_deploy.security.key_lease import lent
from zsim_world.playback.playback import Choice, Playback
from zsim_world.server.world_process import run


class Wish(NamedTuple):
    """How a record is to be played.

    Attributes:
        choice: what of it.
        rate: simulated per wall seconds; 0 = as fast as possible.
        expect: names of the processes that are waited for.
        endpoints: on which others come in.
        federation: None for that of the record.
    """

    choice: Choice
    rate: float
    expect: tuple[str, ...]
    endpoints: tuple[str, ...]
    federation: str | None = None


def play(place: Path, wish: Wish, who: Identity) -> None:
    """Play a record until it is over or somebody stops it.

    Raises:
        RunError, RecordError: there is no record, or nothing in it to play.
        SessionError: an endpoint is taken, a key is no expression, or the identity is of no use.
    """
    for expression in wish.choice.keys:
        session.check_expression(expression)
    leash = Leash(False, lent(who, None))
    with opened(place) as (reader, info, scenario):
        _check(wish.choice.keys, reader)
        if wish.federation is not None:
            federation = keys.name(wish.federation, "federation")
            scenario = msgspec.structs.replace(scenario, federation=federation)
        playback = Playback(reader, scenario, info, wish.choice, wish.rate, time.monotonic_ns)
        for name in wish.expect:
            playback.barrier.expect(name)
        with Screen(scenario.duration_s) as screen:
            where = f"{scenario.federation!r} on {', '.join(wish.endpoints)}"
            text = f"replay of run {info.run_id} as {where}; Ctrl-C ends it"
            run(playback, wish.endpoints, leash.reason, told(screen), lambda: screen.say(text), who)
            for note in record_notes(reader.complete, reader.damaged):
                screen.say(note)
            screen.say(f"ended: {playback.ended}")


def _check(expressions: Sequence[str], reader: RecordReader) -> None:
    """Refuse to play nothing."""
    on_record = reader.topics()
    for expression in expressions:
        if not any(keys.matches(expression, key) for key in on_record):
            raise RunError(f"--keys is {expression!r}; must match a key on record: {', '.join(list(on_record)[:20])} …")
