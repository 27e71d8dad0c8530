"""Points of W on the Earth, against the way back and against formulas of geodesy."""

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import zsim
import zsim_world
from zsim.math.frames import WGS84_A_M, WGS84_F, anchor, geodetic, geodetic_to_enu

ORIGIN = (-34.603, -58.368, 25.0)
few = settings(max_examples=100, deadline=None)


def place_of(position, origin=ORIGIN):
    """Return latitude, longitude and height of one point of W."""
    return geodetic(np.array([position], dtype=float), *anchor(*origin))[0]


@pytest.mark.parametrize(
    "origin", [(37.3, -121.9, 30.0), (-34.603, -58.381, 25.0), (0.0, 180.0, 0.0), (89.9, 0.0, 5e3)]
)
def test_the_way_back_is_that_of_frames(origin):
    points = np.random.default_rng(2).normal(size=(50, 3)) * (1e3, 1e3, 1e2)
    np.testing.assert_allclose(geodetic_to_enu(geodetic(points, *anchor(*origin)), origin), points, atol=1e-7)


@few
@given(st.floats(-89.9, 89.9), st.floats(-179.9, 179.9), st.floats(-5e3, 1e5))
def test_an_origin_is_where_it_is(latitude, longitude, height):
    back = place_of((0.0, 0.0, 0.0), (latitude, longitude, height))
    np.testing.assert_allclose(back[:2], (latitude, longitude), atol=2e-14 * 180)
    assert abs(back[2] - height) < 1e-8


@few
@given(st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-100.0, 1e4)))
def test_tangent_plane_round_trip_is_exact(position):
    np.testing.assert_allclose(geodetic_to_enu(place_of(position), ORIGIN), position, atol=1e-8)


def test_up_is_height():
    np.testing.assert_allclose(place_of((0, 0, 7.0)), (ORIGIN[0], ORIGIN[1], 32.0), atol=1e-9)


def test_small_steps_follow_the_radii_of_curvature():
    # an independent formula: meridian radius M and normal radius N at the origin
    lat = math.radians(ORIGIN[0])
    e2 = WGS84_F * (2 - WGS84_F)
    s = 1 - e2 * math.sin(lat) ** 2
    meridian = WGS84_A_M * (1 - e2) / s**1.5 + ORIGIN[2]
    normal = WGS84_A_M / math.sqrt(s) + ORIGIN[2]
    north, east = place_of((0, 1.0, 0)), place_of((1.0, 0, 0))
    assert math.isclose(math.radians(north[0] - ORIGIN[0]), 1 / meridian, rel_tol=1e-6)
    assert math.isclose(math.radians(east[1] - ORIGIN[1]), 1 / (normal * math.cos(lat)), rel_tol=1e-6)


ASK = """
import numpy as np
from zsim.math.frames import geodetic
print(geodetic(np.zeros((1, 3)), np.eye(3), np.array((6_378_144.0, 0.0, 0.0)))[0, 2])
"""


def test_a_change_of_a_constant_that_is_compiled_in_reaches_the_kernel(tmp_path):
    """The radius stands in zsim/math/frames.py: numba's own cache would go on with the old one."""
    for package in (zsim, zsim_world):
        source = Path(package.__path__[0])
        shutil.copytree(source, tmp_path / source.name, ignore=shutil.ignore_patterns("__pycache__"))

    def height_m() -> float:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        run = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}){ASK}"]
        return float(subprocess.run(run, env=environment, capture_output=True, text=True, check=True).stdout)

    assert height_m() == pytest.approx(7.0)
    frames = tmp_path / "zsim" / "math" / "frames.py"
    text = frames.read_text()
    assert text.count("\nWGS84_A_M = 6_378_137.0") == 1
    frames.write_text(text.replace("WGS84_A_M = 6_378_137.0", "WGS84_A_M = 6_400_000.0"))
    assert height_m() == pytest.approx(7.0 - 21_863.0)


def test_no_fix_is_none():
    assert geodetic(np.zeros((0, 3)), *anchor(10.0, 20.0, 30.0)).shape == (0, 3)
