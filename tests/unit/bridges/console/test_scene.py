"""Colours of the scene's lines."""

import numpy as np
import pytest

from zsim.drone_colours import drone_colours, rgb
from zsim_bridges.console import airframe
from zsim_bridges.console.scene import DARK, LIGHT, LUMINANCE_MIN, lightened, linear, luminance

CONTRAST_MIN = 2.3  # of what is drawn with the ground; text, which is finer, needs 4.5 (WCAG 2.2)


def test_colours_of_lines_are_in_linear_light() -> None:
    """Half of the light of white is 188 of 255 in sRGB."""
    assert linear(np.array([[0, 188, 255], [5, 10, 128]])).tolist() == [[0, 128, 255], [0, 1, 55]]


@pytest.mark.parametrize("ground", [LIGHT[0], DARK[0]])
@pytest.mark.parametrize("part", ["cross", "hull", "rotor"])
def test_drones_are_seen_on_the_ground_of_both_themes(ground: tuple[int, int, int], part: str):
    light, dark = sorted((luminance(airframe.COLOURS[part]), luminance(ground)), reverse=True)
    assert (light + 0.05) / (dark + 0.05) > CONTRAST_MIN


@pytest.mark.parametrize("count", [3, 30])
def test_trails_are_seen_on_dark_ground_and_light_ones_are_as_they_were(count: int):
    for colour in map(rgb, drone_colours(count)):
        seen = lightened(colour)
        assert (luminance(seen) + 0.05) / (luminance(DARK[0]) + 0.05) > CONTRAST_MIN
        assert luminance(colour) < LUMINANCE_MIN or list(seen) == list(colour)
