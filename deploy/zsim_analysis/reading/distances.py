"""How far the drones are apart over time, in truth. Pure."""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from zsim.errors import ZsimError
from zsim.vehicles.vehicle_catalogue import vehicle_of
from zsim_analysis.reading.formation import common_instants
from zsim_analysis.reading.recorded_flight import Array, RecordedFlight

INSTANTS = 1500  # at which distances are computed, spread over the flight: more than a figure has pixels


class Distances(NamedTuple):
    """True distances of the drones at K instants.

    Attributes:
        t_s: (K,) simulated time.
        pairs: names of the drones of each pair, in the order of the columns of `between`.
        between: (K, P) [m] of every pair; no column where there are more pairs than were asked for.
        nearest: (K, N) [m] of each drone to the nearest other one.
    """

    t_s: Array
    pairs: tuple[tuple[str, str], ...]
    between: Array
    nearest: Array


class Separations(NamedTuple):
    """Distances [m] that a flight is to keep: by its controllers' margins, and where two hulls touch; None unknown."""

    margin_m: float | None
    alarm_m: float | None
    touch_m: float | None


def distances(flight: RecordedFlight, pairs_max: int) -> Distances | None:
    """Return the distances of simulated drones, of each pair where there are no more than so many; None below two."""
    tracks = [track for track in flight.tracks if len(track.t_ns) and not track.external]
    t_ns, places = common_instants(tracks)
    if len(tracks) < 2 or not len(t_ns):
        return None
    rows = np.unique(np.linspace(0, len(t_ns) - 1, INSTANTS).astype(int))
    p_W = np.stack([track.p_W[place[rows]] for track, place in zip(tracks, places, strict=True)], axis=1)
    names = list(combinations(range(len(tracks)), 2))
    pairs = names if len(names) <= pairs_max else []
    columns = [np.linalg.norm(p_W[:, i] - p_W[:, j], axis=1) for i, j in pairs]
    between = np.column_stack(columns) if columns else np.zeros((len(rows), 0))
    named = tuple((tracks[i].name, tracks[j].name) for i, j in pairs)
    return Distances(t_ns[rows] / 1e9, named, between, _nearest(p_W))


def _nearest(p_W: Array) -> Array:
    """Return the distances (K, N) of drones at positions (K, N, 3) to the nearest other one."""
    nearest = np.full(p_W.shape[:2], np.inf)
    for i, j in combinations(range(p_W.shape[1]), 2):
        apart = np.linalg.norm(p_W[:, i] - p_W[:, j], axis=1)
        nearest[:, i] = np.minimum(nearest[:, i], apart)
        nearest[:, j] = np.minimum(nearest[:, j], apart)
    return nearest


def separations(flight: RecordedFlight) -> Separations:
    """Return what the scenario of a flight says of the distances of its drones: the largest of its clusters."""
    gains = [cluster.gains for cluster in flight.scenario.clusters] if flight.scenario else []
    margin_m = max((each.separation_min_m for each in gains), default=None)
    alarm_m = max((each.separation_alarm_m for each in gains), default=None)
    return Separations(margin_m, alarm_m, _touch_m(flight))


def _touch_m(flight: RecordedFlight) -> float | None:
    """Return the distance at which the two largest hulls touch; None where a model is not known here."""
    try:
        radii = (
            [vehicle_of(drone.model).airframe.hull_radius_m for drone in flight.scenario.drones]
            if flight.scenario
            else []
        )
    except ZsimError:
        return None
    return sum(sorted(radii)[-2:]) if len(radii) > 1 else None
