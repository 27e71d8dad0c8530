"""The compiled way of a GPS fix to latitude and longitude, against the one of zsim.frames."""

import numpy as np
import pytest

from zsim.frames import enu_to_geodetic
from zsim_world.geodetic import anchor, geodetic


@pytest.mark.parametrize(
    "origin", [(37.3, -121.9, 30.0), (-34.603, -58.381, 25.0), (0.0, 180.0, 0.0), (89.9, 0.0, 5e3)]
)
def test_it_agrees_with_frames(origin):
    points = np.random.default_rng(2).normal(size=(50, 3)) * (1e3, 1e3, 1e2)
    found = geodetic(points, *anchor(*origin))
    wanted = enu_to_geodetic(points, origin)
    np.testing.assert_allclose(found[:, :2], wanted[:, :2], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found[:, 2], wanted[:, 2], rtol=0.0, atol=1e-8)


def test_no_fix_is_none():
    assert geodetic(np.zeros((0, 3)), *anchor(10.0, 20.0, 30.0)).shape == (0, 3)
