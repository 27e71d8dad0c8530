"""The laws as implemented reproduce the results of the papers."""

import math

import numpy as np
import pytest

from zsim_analysis.board.papers import GRAPHS, bearing_flight, delay_margin, free_flock, laplacian


@pytest.mark.parametrize("name", ["ring", "complete"])
def test_consensus_oscillates_beyond_the_delay_margin(name: str) -> None:
    """Both have degenerate fastest modes; an Euler step adds a delay of h / 2."""
    margin = math.pi / (2 * float(np.linalg.eigvalsh(laplacian(GRAPHS[name]))[-1]))
    assert delay_margin(GRAPHS[name]) == pytest.approx(margin, rel=0.01)


def test_a_flock_forms_one_lattice_only_with_an_aim() -> None:
    led, free = free_flock(n=40), free_flock(n=40, with_aim=False)
    assert led.connectivity[0] < 0.5
    assert led.connectivity[-1] == 1.0 > free.connectivity[-1]
    assert led.energy[-1] < 0.02 < led.energy[0]
    assert led.mismatch[-1] < 0.3 < free.mismatch[-1]


def test_bearings_keep_centroid_and_scale_and_converge_monotonically() -> None:
    track = bearing_flight()
    assert track.centroid_drift < 1e-9
    assert track.scale_drift < 1e-5  # error of the integration
    assert np.all(np.diff(track.distance[track.distance > 1e-5]) < 0)
    assert track.distance[-1] < 1e-4
