"""The compiled way of a GPS fix to latitude and longitude, against the one of zsim.math.frames."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import zsim
import zsim_world
from zsim.math.frames import enu_to_geodetic
from zsim.math.geodetic import anchor, geodetic


@pytest.mark.parametrize(
    "origin", [(37.3, -121.9, 30.0), (-34.603, -58.381, 25.0), (0.0, 180.0, 0.0), (89.9, 0.0, 5e3)]
)
def test_it_agrees_with_frames(origin):
    points = np.random.default_rng(2).normal(size=(50, 3)) * (1e3, 1e3, 1e2)
    found = geodetic(points, *anchor(*origin))
    wanted = enu_to_geodetic(points, origin)
    np.testing.assert_allclose(found[:, :2], wanted[:, :2], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found[:, 2], wanted[:, 2], rtol=0.0, atol=1e-8)


ASK = """
import numpy as np
from zsim.math.geodetic import geodetic
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
