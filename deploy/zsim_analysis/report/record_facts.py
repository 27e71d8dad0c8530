"""What is on record of a flight, and what is missing. Pure."""

import numpy as np
from msgspec import Struct

from zsim.contract.fingerprint import TruthHash
from zsim_analysis.reading.recorded_flight import TRUTH_WIDTH, RecordedFlight, Track


class RecordFacts(Struct, frozen=True):
    """What the report was made from.

    Attributes:
        complete: nothing that the world published is missing, nor the end of the run.
        state: that, and what is missing, in words.
        gates: on record.
        gates_missing: by the clocks.
        gaps: `gates` that are missing one behind the other, `from_s` the first of them `to_s` the last.
        messages_missing: of the world, by their numbers.
        undecoded: messages that are not of the type of their key.
        truth_instants: truth messages that went into the hash: those of simulated drones.
        truth_missing: truth messages that a whole run of this length would have besides.
        truth_sha256: as TruthHash of every one of them, by time, then in the order of the drones.
    """

    messages: int
    complete: bool
    state: str
    gates: int
    gates_missing: int
    gaps: list[dict[str, float]]
    messages_missing: int
    undecoded: int
    truth_instants: int
    truth_missing: int
    truth_sha256: str


def facts_of_record(flight: RecordedFlight, last_ns: int) -> RecordFacts:
    """Return what is on record of a flight whose last instant is at `last_ns` as far as it is known."""
    tracks, state = [track for track in flight.tracks if not track.external], flight.completeness
    t_ns = np.concatenate([track.t_ns for track in tracks] or [np.zeros(0, np.int64)])
    states = np.concatenate([track.truth for track in tracks] or [np.zeros((0, TRUTH_WIDTH))])
    drone = np.repeat(np.arange(len(tracks)), [len(track.t_ns) for track in tracks])
    order, truth = np.lexsort((drone, t_ns)), TruthHash(len(t_ns))
    truth.add(t_ns[order], states[order])
    return RecordFacts(
        messages=flight.messages,
        complete=state.complete,
        state=str(state),
        gates=state.gates,
        gates_missing=state.gates_missing,
        gaps=[{"gates": g.gates, "from_s": g.from_ns / 1e9, "to_s": g.to_ns / 1e9} for g in state.gaps],
        messages_missing=state.messages_missing,
        undecoded=flight.undecoded,
        truth_instants=len(t_ns),
        truth_missing=_missing(flight, tracks, last_ns),
        truth_sha256=truth.hexdigest(),
    )


def _missing(flight: RecordedFlight, tracks: list[Track], last_ns: int) -> int:
    """Return how many truth messages of some drones there are not, every gate from the first one on to the last.

    A flight has truth from 0 or the first gate on, a replay from where it was begun.
    """
    gate_ns = flight.info.gate_ns if flight.info else None
    present = sum(len(track.t_ns) for track in tracks)
    if not gate_ns or not present:
        return 0
    first_ns = flight.first_ns if flight.replay_of else min(flight.first_ns, gate_ns)
    return max(0, len(tracks) * ((last_ns - first_ns) // gate_ns + 1) - present)
