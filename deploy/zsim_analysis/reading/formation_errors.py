"""Figures of merit of a formation flight: pure functions of arrays."""

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim_analysis.reading.flight import Array, Times, Track

BLOCK = 512  # instants whose distances are held at once


class Errors(Struct, frozen=True):
    """Deviations of one cluster parameter from its desired value, in its own unit (m or rad).

    `est` is what the controller saw (estimate − desired), `true` what the drones did (truth − desired), at
    the same instants. std² + mean² = rms². None: no such instant.
    """

    est_std: float | None
    est_rms: float | None
    est_mean: float | None
    true_std: float | None
    true_rms: float | None
    true_mean: float | None


def errors(est: Array, true: Array) -> Errors:
    """Return the statistics of one parameter; `est` and `true` (K,), not finite where unknown."""
    both = np.isfinite(est) & np.isfinite(true)
    return Errors(*_moments(est[both] if both.any() else est), *_moments(true[both]))


def _moments(error: Array) -> tuple[float | None, float | None, float | None]:
    error = error[np.isfinite(error)]
    if not len(error):
        return None, None, None
    return float(error.std()), float(np.sqrt(np.mean(error**2))), float(error.mean())


def window(asked: tuple[float, float] | None, length_s: float) -> tuple[tuple[float, float], str]:
    """Return the window of the statistics [s] of a run, and a note where it is not the one asked for.

    Without one asked for: the last two thirds of the run.
    """
    default = (length_s / 3, length_s)
    if asked is None:
        return default, ""
    start, end = asked
    if end <= length_s:
        return asked, ""
    if start < length_s:
        return (
            start,
            length_s,
        ), f"The run ended at {length_s:.2f} s, inside the window {start:g} to {end:g} s."
    return default, (
        f"The run ended at {length_s:.2f} s, before the window {start:g} to {end:g} s; "
        "the last two thirds of what there is are used."
    )


def common_instants(tracks: list[Track]) -> tuple[Times, list[NDArray[np.intp]]]:
    """Return the instants at which all drones have truth, and where they stand in each track."""
    if not tracks:
        return np.zeros(0, np.int64), []
    t_ns = tracks[0].t_ns
    for track in tracks[1:]:
        t_ns = np.intersect1d(t_ns, track.t_ns, assume_unique=True)
    return t_ns, [np.searchsorted(track.t_ns, t_ns) for track in tracks]


def min_separation_m(tracks: list[Track]) -> float | None:
    """Return the least true distance [m] of two drones that are both in the air.

    Where no status tells who is in the air, all instants count; None when there are no two drones.
    """
    tracks = [track for track in tracks if len(track.t_ns)]
    t_ns, places = common_instants(tracks)
    if len(tracks) < 2 or not len(t_ns):
        return None
    p_W = np.stack([track.p_W[place] for track, place in zip(tracks, places, strict=True)], axis=1)
    flying = np.stack([_airborne(track, t_ns) for track in tracks], axis=1)
    if (flying.sum(axis=1) < 2).all():
        flying[:] = True
    blocks = (slice(start, start + BLOCK) for start in range(0, len(t_ns), BLOCK))
    least = min(_least_distance(p_W[block], flying[block]) for block in blocks)
    return float(least) if np.isfinite(least) else None


def _airborne(track: Track, t_ns: Times) -> NDArray[np.bool_]:
    flying = np.array([state != "landed" for state in track.states], bool)
    if not len(flying):
        return np.zeros(len(t_ns), bool)
    latest = np.searchsorted(track.status_t_ns, t_ns, side="right") - 1
    return flying[np.maximum(latest, 0)]


def _least_distance(p_W: Array, flying: NDArray[np.bool_]) -> float:
    """Return the least distance in positions (T, N, 3) of pairs that both fly (T, N)."""
    least = np.inf
    for i in range(p_W.shape[1] - 1):
        distance = np.linalg.norm(p_W[:, i + 1 :] - p_W[:, i : i + 1], axis=2)
        both = flying[:, i + 1 :] & flying[:, i : i + 1]
        least = min(least, float(distance[both].min(initial=np.inf)))
    return least
