"""The ground of the scene: a field with a grid over it, of all pages or, in its theme, of one."""

import viser

HALF_M = 150.0  # half a side of the ground
FIELD_BELOW_M = 0.15  # of the field below the grid: which of two nearer ones is in front a depth buffer cannot tell
THICK_M = 0.02
LIGHT = ((206, 219, 196), (190, 200, 184), (138, 150, 132))  # of the field, of the grid's cells and of its sections
DARK = ((30, 35, 30), (84, 94, 82), (122, 134, 118))


def draw_ground(scene: viser.SceneApi, *, dark: bool = False) -> None:
    """Draw the ground, in the place of what was drawn before.

    Opaque, and no background image: what viser draws of a grid's plane or of a sky hides whatever is transparent.
    """
    field, cells, sections = DARK if dark else LIGHT
    position = (0.0, 0.0, -FIELD_BELOW_M - THICK_M / 2.0)
    scene.add_box("/field", field, (2 * HALF_M, 2 * HALF_M, THICK_M), position=position, cast_shadow=False)
    scene.add_grid(
        "/ground", 2 * HALF_M, 2 * HALF_M, cell_size=1.0, section_size=5.0, cell_color=cells, section_color=sections,
        fade_distance=80.0, shadow_opacity=0.0,
    )  # fmt: skip
