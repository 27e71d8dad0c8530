"""The history of radio links: number of drones heard, shares, and connectedness."""

import numpy as np
import pytest

from zsim.contract.run_messages import RadioLinks
from zsim_analysis.reading.recorded_flight import RadioHistory

SECOND = 1_000_000_000
RING = ((1,), (2,), (0,))  # three drones, each of which hears the next: connected over several hops
PAIR = ((1,), (0,), ())
WITH_STATION = ((1, 3), (0,), (3,), (0, 1, 2))  # the station hears all drones, but is not a drone


def history(*hears: tuple[tuple[int, ...], ...]) -> RadioHistory:
    links = [RadioLinks(t * SECOND, t, each) for t, each in enumerate(hears)]
    return RadioHistory([*reversed(links), links[0]], 3)  # out of order and with a duplicate


def test_neighbours_shares_and_connectedness_are_found() -> None:
    made = history(RING, PAIR, WITH_STATION, RING)
    assert made.heard.tolist() == [[1, 1, 1], [1, 1, 0], [1, 1, 0], [1, 1, 1]]
    assert made.connected.tolist() == [True, False, False, True]
    np.testing.assert_allclose(made.share, [[0, 1, 0], [0.5, 0, 0.5], [0.5, 0, 0]])


def test_means_are_those_of_the_window() -> None:
    summary = history(RING, PAIR, PAIR, RING).summary((1.0, 3.0))
    assert summary is not None
    assert summary.heard_mean == pytest.approx((2 / 3 + 2 / 3 + 1) / 3)
    assert summary.connected_share == pytest.approx(1 / 3)
    assert history(RING).summary((5.0, 9.0)) is None


def test_partial_reception_counts_in_part() -> None:
    """d0 hears d1 with 0.8 and d2 with 0.3, too little to connect; a quarter of all messages is lost."""
    links = [RadioLinks(0, 0, ((1, 2), (0, 2), (0, 1)), ((0.8, 0.3), (0.8, 0.4), (0.3, 0.4)))]
    made = RadioHistory(links, 3, loss=0.25)
    np.testing.assert_allclose(made.heard, 0.75 * np.array([[1.1, 1.2, 0.7]]))
    np.testing.assert_allclose(made.share[0], [0, 0.6, 0.225])
    assert made.connected.tolist() == [False]
