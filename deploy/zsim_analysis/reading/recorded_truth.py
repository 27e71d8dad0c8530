"""The fingerprint of a flight, computed again from the record."""

import hashlib

import numpy as np
from msgspec import Struct

from zsim_analysis.reading.flight import TRUTH_WIDTH, Track

_ROW = np.dtype([("t", "<i8"), ("x", "<f8", TRUTH_WIDTH)])


class TruthHash(Struct, frozen=True):
    """SHA-256 of the truth on record, and how much of it that is.

    Attributes:
        sha256: over t_ns, position, velocity, orientation, angular velocity of every truth message, by time,
            then in the order of the drones; little-endian.
        instants: truth messages that went into it.
        missing: truth messages that a whole run of this length would have besides.
    """

    sha256: str
    instants: int
    missing: int


def truth_hash(tracks: list[Track], gate_ns: int | None, first_ns: int, last_ns: int) -> TruthHash:
    """Return the hash of the truth of drones in scenario order.

    Args:
        tracks: the drones.
        gate_ns: spacing of truth; None: unknown, then none is missing.
        first_ns: the first instant of the run.
        last_ns: the last instant of the run as far as it is known.
    """
    rows = np.concatenate([_rows(track) for track in tracks] or [np.zeros(0, _ROW)])
    drone = np.repeat(np.arange(len(tracks)), [len(track.t_ns) for track in tracks])
    ordered = rows[np.lexsort((drone, rows["t"]))]
    return TruthHash(
        hashlib.sha256(ordered.tobytes()).hexdigest(), len(rows), _missing(tracks, gate_ns, first_ns, last_ns)
    )


def _rows(track: Track) -> np.ndarray:
    rows = np.zeros(len(track.t_ns), _ROW)
    rows["t"], rows["x"] = track.t_ns, track.truth
    return rows


def _missing(tracks: list[Track], gate_ns: int | None, first_ns: int, last_ns: int) -> int:
    """Return how many truth messages there are not, every gate from the first one on to the last."""
    if not gate_ns or not any(len(track.t_ns) for track in tracks):
        return 0
    expected = len(tracks) * ((last_ns - first_ns) // gate_ns + 1)
    return max(0, expected - sum(len(track.t_ns) for track in tracks))
