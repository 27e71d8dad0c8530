"""What stands above a figure whose flight is not what it may be taken for."""

from textwrap import wrap

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from zsim_analysis.report.pages import PAPER_PT

MARK_EMS, LINE_EMS = 0.75, 1.25  # width of a bold letter and height of a line, in the text's size
MARK_LINES, MARK_PAD_IN = 4, 0.05  # of the reason in a mark above a figure, and room above the mark


def mark_figure(figure: Figure, head: str, reason: str, colour: str) -> None:
    """Write above a figure that its flight is not what it may be taken for, on room of its own.

    Args:
        figure: already drawn, with its legend; it grows by the height of the mark.
        head: the first line.
        reason: in as many lines below as it takes, cut where these are too many.
        colour: of the text.
    """
    width_in, height_in = figure.get_size_inches()
    letters = int(72 * width_in / (MARK_EMS * PAPER_PT))
    lines = [head, *wrap(reason, letters, max_lines=MARK_LINES, placeholder=" …")]
    mark_in = len(lines) * LINE_EMS * PAPER_PT / 72 + MARK_PAD_IN
    whole_in = height_in + mark_in
    mark = figure.suptitle("\n".join(lines), va="top", color=colour, fontsize=PAPER_PT, fontweight="bold")
    mark.set_y(1 - MARK_PAD_IN / whole_in)
    mark.set_in_layout(False)  # matplotlib would lay it over a legend that stands above the axes
    figure.set_size_inches(width_in, whole_in)
    _lower(figure, height_in / whole_in)


def _lower(figure: Figure, top: float) -> None:
    """Lay out axes of a figure, and the legends above them, below a share of its height."""
    height_px, room_px = figure.bbox.height, 0.0
    boxes = [(legend, legend.get_window_extent()) for legend in figure.legends]
    for legend, box in boxes:
        if box.y0 > height_px / 2:  # not one below the axes
            room_px = max(room_px, box.height + figure.dpi * PAPER_PT / 72)
            legend.set_bbox_to_anchor((0.0, 0.0, 1.0, top), figure.transFigure)
    axes_top = top - room_px / height_px  # a legend with a place of its own is not laid out for
    if isinstance(engine := figure.get_layout_engine(), ConstrainedLayoutEngine):
        engine.set(rect=(0.0, 0.0, 1.0, axes_top))
