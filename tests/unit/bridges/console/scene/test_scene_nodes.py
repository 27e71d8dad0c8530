"""Colours of the scene's lines."""

import numpy as np

from zsim_bridges.console.scene.scene_nodes import linear


def test_colours_of_lines_are_in_linear_light() -> None:
    """Half of the light of white is 188 of 255 in sRGB."""
    assert linear(np.array([[0, 188, 255], [5, 10, 128]])).tolist() == [[0, 128, 255], [0, 1, 55]]
