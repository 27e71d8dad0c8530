"""The fingerprint of a flight, computed again from the record."""

import numpy as np
from msgspec import Struct

from zsim.contract.fingerprint import TruthHash
from zsim_analysis.reading.flight import TRUTH_WIDTH, Track


class RecordedTruth(Struct, frozen=True):
    """SHA-256 of the truth on record, and how much of it that is.

    Attributes:
        sha256: as TruthHash of every truth message, by time, then in the order of the drones.
        instants: truth messages that went into it.
        missing: truth messages that a whole run of this length would have besides.
    """

    sha256: str
    instants: int
    missing: int


def recorded_truth(tracks: list[Track], gate_ns: int | None, first_ns: int, last_ns: int) -> RecordedTruth:
    """Return the hash of the truth of drones in scenario order.

    Args:
        tracks: the drones.
        gate_ns: spacing of truth; None: unknown, then none is missing.
        first_ns: the first instant of the run.
        last_ns: the last instant of the run as far as it is known.
    """
    t_ns = np.concatenate([track.t_ns for track in tracks] or [np.zeros(0, np.int64)])
    states = np.concatenate([track.truth for track in tracks] or [np.zeros((0, TRUTH_WIDTH))])
    drone = np.repeat(np.arange(len(tracks)), [len(track.t_ns) for track in tracks])
    order, truth = np.lexsort((drone, t_ns)), TruthHash(len(t_ns))
    truth.add(t_ns[order], states[order])
    return RecordedTruth(truth.hexdigest(), len(t_ns), _missing(tracks, gate_ns, first_ns, last_ns))


def _missing(tracks: list[Track], gate_ns: int | None, first_ns: int, last_ns: int) -> int:
    """Return how many truth messages there are not, every gate from the first one on to the last."""
    if not gate_ns or not any(len(track.t_ns) for track in tracks):
        return 0
    expected = len(tracks) * ((last_ns - first_ns) // gate_ns + 1)
    return max(0, expected - sum(len(track.t_ns) for track in tracks))
