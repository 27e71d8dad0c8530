"""The measures of a board on motions with known results."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from zsim.record.completeness import Completeness
from zsim_agents.laws.pilot import polygon
from zsim_analysis.board.measures import DesiredTrack, FormationTrack, formation_track, lattice_errors, shape_errors
from zsim_analysis.reading.recorded_flight import RecordedFlight, Track

C = polygon(5, 3.0)
T = np.arange(4.0)
MOVED = np.array([3.0, 4.0])


def turned(c: NDArray[Any], degrees: float) -> NDArray[Any]:
    s, k = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    return c @ np.array([[k, s], [-s, k]])


def error(p: NDArray[Any], *invariances: str) -> float:
    wanted = np.broadcast_to(C, (4, 5, 2))
    flown = FormationTrack(T, np.broadcast_to(p, (4, 5, 2)).copy(), DesiredTrack(np.zeros((4, 2)), wanted, invariances))
    return float(shape_errors(flown)[0])


@pytest.mark.parametrize(
    ("p", "invariances", "wanted"),
    [
        (C + MOVED, (), 5.0),
        (C + MOVED, ("translation",), 0.0),
        (turned(C, 60), ("translation",), 3.0),  # each moves by a chord of its circle
        (turned(C, 60) + 7, ("translation", "rotation"), 0.0),
        (1.5 * C - 2, ("translation",), 1.5),
        (1.5 * C - 2, ("translation", "rotation"), 1.5),
        (1.5 * C - 2, ("translation", "scale"), 0.0),
        (-C, ("translation", "scale"), 3.0),  # point reflection, which no positive scale undoes
        (C * [1, -1], ("translation", "rotation"), 3.0 * math.sqrt(2)),  # a mirrored figure differs
    ],
)  # fmt: skip
def test_the_shape_error_ignores_the_invariances_of_the_law(
    p: Any, invariances: tuple[str, ...], wanted: float
) -> None:
    assert error(p, *invariances) == pytest.approx(wanted, abs=1e-9)


def test_drones_on_the_ground_do_not_count() -> None:
    lost = C + MOVED
    lost[4] = np.nan
    assert error(lost, "translation") == pytest.approx(0.0, abs=1e-9)
    lost[1:] = np.nan
    assert math.isnan(error(lost, "translation"))


def test_drones_without_status_do_not_count() -> None:
    t_ns = np.arange(3) * 1_000_000_000
    tracks = [
        Track(f"drone{i}", t_ns, np.full((3, 13), float(i)), t_ns[: len(states)], states, np.zeros(len(states)))
        for i, states in enumerate((["flying"] * 3, []))
    ]
    flight = RecordedFlight(None, None, tracks, [], [], [], 0, Completeness(), 0.0)
    p = formation_track(flight, entire_flight=True).p
    assert np.isfinite(p[:, 0]).all()
    assert np.isnan(p[:, 1]).all()


def test_the_lattice_error_counts_only_sides_within_range() -> None:
    triangle = np.array([[[0.0, 0], [3.5, 0], [1.75, 3.5 * math.sqrt(0.75)], [1.75, 20]]])
    assert lattice_errors(triangle, 3.5, 4.2)[0] == pytest.approx(0.0, abs=1e-12)
    assert lattice_errors(triangle, 3.0, 4.2)[0] == pytest.approx(0.5)
    assert math.isnan(lattice_errors(triangle, 1.0, 1.2)[0])
