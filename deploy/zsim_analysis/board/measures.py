"""Measures of how well a formation was flown, the same for all laws.

Errors and separation follow from the true motion within the report's window; effort, messages and CPU time are those
of the whole flight. `measures` is a function for `report.metrics`, so that sweeps over a law's parameters can use it:

    zsim sweep scenario.yaml --vary agents.pilot.parameters.gain_1_s=0.2,0.4 \
        --set report.metrics=zsim_analysis.board.measures:measures

Errors and separation are those of the drones in the air only. The reference is always the plan's, even while drones
are held.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import msgspec
import numpy as np

from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim_agents.laws.olfati_saber import OlfatiSaber
from zsim_agents.laws.pilot import AIRBORNE, FormationReference, Motion, Pilot, polygon
from zsim_agents.laws.shape import ShapePilot
from zsim_analysis.reading.formation import common_instants, min_separation_m
from zsim_analysis.reading.recorded_flight import Array, RecordedFlight, Track
from zsim_analysis.reading.shortfall import window_of


class Figure(NamedTuple):
    """The desired figure of a formation."""

    reference: FormationReference
    places: Array | None  # (n, 2) positions of the drones in the figure [m]; None for laws without positions
    invariances: tuple[str, ...]  # of "translation", "rotation" and "scale", those that the law leaves open


class DesiredTrack(NamedTuple):
    """The desired figure of a formation over time."""

    centre: Array  # (T, 2) desired centre [m; W]
    places: Array | None  # (T, n, 2) desired positions [m; W]; None for laws without positions
    invariances: tuple[str, ...]  # as in `Figure`


class FormationTrack(NamedTuple):
    """The horizontal motion of a formation, within the report's window or over the whole flight."""

    t_s: Array  # (T,)
    p: Array  # (T, n, 2) true positions [m; W]; NaN for drones that are not in the air
    desired: DesiredTrack | None


def measures(flight: RecordedFlight, figure: Figure | None = None) -> dict[str, float | None]:
    """Return the measures of a flight; None for a measure that it does not have.

    shape_error_m: RMS distance of the drones from the figure's positions, after the best translation, rotation and
        scaling that the law leaves open; for a lattice, RMS deviation of its sides from the spacing.
    place_error_m: the same distance without any fit; None for flocks, which have no desired positions.
    centre_error_m: RMS distance of the drones' centre from the desired one.
    effort_m2_s: integral of the squared horizontal velocity command over the whole flight, mean over the drones with
        such commands.
    separation_m: minimum distance between two drones in the air.
    messages_per_drone_s: messages to others, per drone and simulated second: those of the pilots, or the estimates
        that a controller reads and the commands that it sends.
    cpu_per_s: CPU time of the whole flight in one process, per simulated second; None for a record.

    Args:
        flight: the flight as arrays.
        figure: the desired figure; None: that in the pilots' parameters.
    """
    formation = formation_track(flight, figure)
    window_s, _ = window_of(flight)
    length_s = max(flight.last_ns / 1e9, 1e-9)
    clipped = [_within(track, window_s) for track in flight.tracks]
    values: dict[str, float | None] = {
        "shape_error_m": _shape_error(flight.scenario, formation),
        "place_error_m": None,
        "centre_error_m": None,
        "effort_m2_s": _effort(flight),
        "separation_m": min_separation_m(clipped),
        "messages_per_drone_s": _messages(flight) / (len(flight.tracks) * length_s),
        "cpu_per_s": flight.cpu_s / length_s if flight.cpu_s else None,
    }
    if formation.desired is not None:
        centre, positions, _ = formation.desired
        if positions is not None:  # the desired centre of the drones in the air only
            centre = _mean(np.where(np.isnan(formation.p), np.nan, positions))
            values["place_error_m"] = _rms(formation.p - positions)
        values["centre_error_m"] = _rms(_mean(formation.p) - centre)
    return values


def formation_track(
    flight: RecordedFlight, figure: Figure | None = None, entire_flight: bool = False
) -> FormationTrack:
    """Return the motion of all drones within the report's window, or over the whole flight."""
    (start, end), _ = window_of(flight)
    if entire_flight:
        start, end = flight.first_ns / 1e9, flight.last_ns / 1e9
    tracks = flight.tracks
    t_ns, rows = common_instants(tracks)
    is_inside = (t_ns >= start * 1e9) & (t_ns <= end * 1e9)
    p = np.stack([track.p_W[row[is_inside], :2] for track, row in zip(tracks, rows, strict=True)], axis=1)
    t_ns = t_ns[is_inside]
    for column, track in enumerate(tracks):
        if not track.states:
            p[:, column] = np.nan
            continue
        latest = np.searchsorted(track.status_t_ns, t_ns, side="right") - 1
        aloft = np.array([state in AIRBORNE for state in track.states], bool)
        p[~aloft[np.maximum(latest, 0)], column] = np.nan
    t_s, figure = t_ns / 1e9, figure or figure_of(flight.scenario)
    return FormationTrack(t_s, p, _desired_track(figure, t_s) if figure else None)


def shape_errors(formation: FormationTrack) -> Array:
    """Return the root mean square distance from the best-fitting positions over time (T,) [m].

    The figure is translated, rotated and scaled to fit, where the law leaves this open. NaN if there are no desired
    positions or fewer than two drones are in the air.
    """
    desired = formation.desired
    if desired is None or desired.places is None:
        return np.full(len(formation.t_s), np.nan)
    planes = (formation.p, np.where(np.isnan(formation.p), np.nan, desired.places))
    p, c = (each[..., 0] + 1j * each[..., 1] for each in planes)  # positions in the plane as complex numbers
    with np.errstate(invalid="ignore", divide="ignore"):
        if "translation" in desired.invariances:
            p, c = p - _mean(p)[:, None], c - _mean(c)[:, None]
        product, size = np.nansum(c.conj() * p, axis=1), np.nansum(np.abs(c) ** 2, axis=1)
        rotation = product / np.abs(product) if "rotation" in desired.invariances else np.ones(len(p), complex)
        scaling = (
            np.maximum((product / rotation).real, 0.0) / size if "scale" in desired.invariances else np.ones(len(p))
        )
        errors = np.sqrt(_mean(np.abs(p - (scaling * rotation)[:, None] * c) ** 2).real)
    return np.where((~np.isnan(p)).sum(axis=1) > 1, errors, np.nan)


def lattice_errors(p: Array, spacing_m: float, reach_m: float) -> Array:
    """Return the root mean square deviation of sides shorter than `reach_m` from the spacing, over time (T,) [m]."""
    i, j = np.triu_indices(p.shape[1], 1)
    lengths = np.linalg.norm(p[:, i] - p[:, j], axis=2)
    squared = np.where(lengths < reach_m, (lengths - spacing_m) ** 2, np.nan)
    return np.sqrt(_mean(squared))


def law_of(scenario: Scenario | None) -> tuple[type[Pilot], Any] | None:
    """Return the law by which pilots fly a scenario, and its parameters; None if no law flies it."""
    for agent in scenario.own_agents.values() if scenario else ():
        kind: Any = plugin.load(agent.named, "class", object)
        if issubclass(kind, Pilot):
            return kind, msgspec.convert(agent.parameters, kind.Parameters)
    return None


def figure_of(scenario: Scenario | None) -> Figure | None:
    """Return the figure in the parameters of a scenario's pilots; None if no law flies it."""
    if scenario is None or (law := law_of(scenario)) is None:
        return None
    kind, parameters = law
    if not issubclass(kind, ShapePilot):
        return Figure(kind.reference_of(parameters), None, ())
    positions = (
        np.array(parameters.places_m) if parameters.places_m else polygon(len(scenario.drones), parameters.radius_m)
    )
    return Figure(kind.reference_of(parameters), positions, kind.invariances)


def _desired_track(figure: Figure, t_s: Array) -> DesiredTrack:
    poses = [figure.reference.at(float(t)) for t in t_s]
    centre = np.array([pose.p_W for pose in poses]).reshape(-1, 2)
    if figure.places is None:
        return DesiredTrack(centre, None, figure.invariances)
    rotations = np.array([pose.turn for pose in poses]).reshape(-1, 2, 2)
    return DesiredTrack(
        centre, centre[:, None] + np.einsum("tij,nj->tni", rotations, figure.places), figure.invariances
    )


def _shape_error(scenario: Scenario | None, formation: FormationTrack) -> float | None:
    law = law_of(scenario)
    if law and issubclass(law[0], OlfatiSaber):
        spacing_m = law[1].spacing_m
        return _root_mean_square(lattice_errors(formation.p, spacing_m, law[1].range_ratio * spacing_m))
    return _root_mean_square(shape_errors(formation))


def _effort(flight: RecordedFlight) -> float | None:
    efforts = []
    for track in flight.tracks:
        commands = flight.commands.get(track.name)
        if commands is None:
            continue
        squared = np.sum(commands.velocity[:, :2] ** 2, axis=1)
        efforts.append(float(np.sum(squared[:-1] * np.diff(commands.t_ns / 1e9))))
    return float(np.mean(efforts)) if efforts else None


def _messages(flight: RecordedFlight) -> int:
    if law_of(flight.scenario):
        return sum(count for key, count in flight.others.items() if key.endswith(Motion.key.rpartition("/")[2]))
    received = sum(len(each.t_ns) for each in flight.estimates.values())
    return received + sum(len(each.t_ns) for each in flight.commands.values()) if flight.clusters else 0


def _within(track: Track, window_s: tuple[float, float]) -> Track:
    is_inside = (track.t_ns >= window_s[0] * 1e9) & (track.t_ns <= window_s[1] * 1e9)
    return replace(track, t_ns=track.t_ns[is_inside], truth=track.truth[is_inside])


def _mean(values: Any) -> Any:
    """Return the mean over the drones (second axis), ignoring NaN; NaN where all are NaN."""
    finite = ~np.isnan(values)
    count = finite.sum(axis=1)
    return np.where(count > 0, np.nansum(values, axis=1) / np.maximum(count, 1), np.nan)


def _rms(vectors: Array) -> float | None:
    return _root_mean_square(np.linalg.norm(vectors, axis=-1))


def _root_mean_square(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None
