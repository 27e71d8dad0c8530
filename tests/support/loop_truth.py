"""The true formation of a run some of whose drones fly in another world, as hardware would, from the two records."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zsim.contract import keys
from zsim.record.record_reader import RecordReader
from zsim_analysis.reading.formation import Formation, formation
from zsim_analysis.reading.recorded_flight import RecordedFlight, Track, read_flight


def offset_ns(record: Path, drone: str, rate: float) -> float:
    """Return wall time times rate minus simulated time of a record [ns], the median over a drone's truth."""
    with RecordReader(record) as reader:
        truths = list(reader.messages([keys.truth(drone)]))
        return float(np.median([rate * each.wall_ns - each.t_ns for each in truths]))


def moved(track: Track, t_ns: NDArray[np.int64], by_ns: float) -> Track:
    """Return a track of another world interpolated at instants of this one; `by_ns` is added to its times."""
    columns = [np.interp(t_ns, track.t_ns + by_ns, column) for column in track.truth.T]
    return Track(track.name, t_ns, np.stack(columns, axis=1), track.status_t_ns, track.states, track.battery_percent)


def true_formation(run: Path, hardware: Path, drones: Sequence[str], rate: float = 1.0) -> Formation:
    """Return the formation of a run in which the true motion of `drones` is from the record `hardware`."""
    flight: RecordedFlight = read_flight(run)
    there = {track.name: track for track in read_flight(hardware).tracks}
    tracks = {track.name: track for track in flight.tracks}
    by_ns = offset_ns(hardware, drones[0], rate) - offset_ns(run, drones[0], rate)
    for drone in drones:
        tracks[drone] = moved(there[drone], tracks[drone].t_ns, by_ns)
    made = formation(flight.clusters[0], list(tracks.values()), flight.scenario)
    assert made is not None
    return made
