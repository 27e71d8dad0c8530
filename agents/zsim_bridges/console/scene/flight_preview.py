"""What a formation would fly, before it is asked to: the ways of its drones, and figures of them. Pure."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from zsim_agents.formation.flight_plan import REFUSALS, Follow, MoveTo, read_request
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.trajectory import Reference
from zsim_bridges.console.scene.picture import Array

POINTS = 121  # of a way; chosen: a curve in 3-D looks smooth
WAY_SHARE = 0.25  # of them, on the way to the start of a trajectory
ENDLESS_S = 120.0  # simulated; how far one without an end is shown
SPEED_POINTS_MIN = 2


class PreviewError(ValueError):
    """What is asked for cannot be flown from where the formation is."""


class FlightPreview(NamedTuple):
    """Ways of n drones.

    Attributes:
        paths_W: (n, M, 3) m, from where they are desired now.
        text: figures of the ways.
    """

    paths_W: Array
    text: str


def preview_of(space: ClusterSpace, op: str, args: Mapping[str, Any], base: Array, apart_min_m: float) -> FlightPreview:
    """Return the ways of a `target` or `trajectory`; the controller may still refuse it, or fly it slower.

    Args:
        space: of the formation.
        op, args: of the request, as they go over the wire.
        base: (4n,), where the formation is desired now.
        apart_min_m: least distance of two drones, which the controller asks for.

    Raises:
        PreviewError: it can be flown by no formation of this space.
    """
    try:
        request = read_request(op, args)
        if isinstance(request, MoveTo):
            return _preview(space, _way(space, base, request.goal(space, base), POINTS), "", apart_min_m)
        assert isinstance(request, Follow)
        reference = request.trajectory(space, base)
        flown, span_s = _sampled(reference)
        way = _way(space, base, flown[0], round(POINTS * WAY_SHARE))
        timed = _preview(space, flown, f"{span_s:g} s{'' if reference.duration_s else ' of it'}", apart_min_m, span_s)
        return FlightPreview(np.concatenate((_places(space, way), timed.paths_W), axis=1), timed.text)
    except REFUSALS as error:
        raise PreviewError(str(error)) from None


def _way(space: ClusterSpace, start: Array, goal: Array, count: int) -> Array:
    """Return the way of a ramp in cluster space, (count, 4n): straight, angles the short way."""
    step = space.difference(goal, start)
    return start + np.linspace(0.0, 1.0, count)[:, None] * step


def _sampled(reference: Reference) -> tuple[Array, float]:
    span_s = reference.duration_s or ENDLESS_S
    return np.array([reference.value(t_s)[0] for t_s in np.linspace(0.0, span_s, POINTS)]), span_s


def _places(space: ClusterSpace, way: Array) -> Array:
    """Return the places (n, M, 3) of the drones along a way (M, 4n)."""
    return np.array([space.inverse(c)[0] for c in way]).transpose(1, 0, 2)


def _preview(space: ClusterSpace, way: Array, what: str, apart_min_m: float, span_s: float = 0.0) -> FlightPreview:
    paths_W = _places(space, way)
    heights_m = paths_W[:, :, 2]
    figures = [what] if what else [f"{_longest_m(paths_W):.1f} m at most"]
    figures.append(f"heights {heights_m.min():.1f} to {heights_m.max():.1f} m")
    if span_s > 0.0 and paths_W.shape[1] >= SPEED_POINTS_MIN:
        steps_m = np.linalg.norm(np.diff(paths_W, axis=1), axis=2)
        figures.append(f"{steps_m.max() * (paths_W.shape[1] - 1) / span_s:.1f} m/s at most")
    apart_m = min(
        (float(np.linalg.norm(paths_W[i] - paths_W[k], axis=1).min()) for i in range(len(paths_W)) for k in range(i)),
        default=math.inf,
    )
    too_near = f", less than the {apart_min_m:g} m that the controller asks for" if apart_m < apart_min_m else ""
    return FlightPreview(paths_W, "; ".join([*figures, f"drones {apart_m:.1f} m apart at least{too_near}"]))


def _longest_m(paths_W: Array) -> float:
    return float(np.linalg.norm(np.diff(paths_W, axis=1), axis=2).sum(axis=1).max())
