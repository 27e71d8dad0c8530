"""What a page's camera has in view."""

import math

import numpy as np
import pytest

from zsim_bridges.console.page_cameras import FAR_M, CameraView

NORTHWARDS = CameraView(np.zeros(3), np.array([0.0, 2.0, 0.0]), np.array([0.0, 0.0, 1.0]), math.radians(90), 1.5)


@pytest.mark.parametrize(
    ("p_W", "seen"),
    [
        ((0.0, 5.0, 0.0), True),
        ((6.0, 5.0, 0.0), True),  # to the right, where a page is wider than high
        ((0.0, 5.0, 6.0), False),
        ((0.0, 5.0, -6.0), False),
        ((-9.0, 5.0, 0.0), False),
        ((0.0, -5.0, 0.0), False),  # behind
        ((0.0, FAR_M + 1.0, 0.0), False),
    ],
)
def test_a_point_is_in_view_where_the_page_shows_it(p_W: tuple[float, float, float], seen: bool):
    assert NORTHWARDS.contains(np.array(p_W)) == seen
