"""Fixtures of the tests of reports."""

import pytest

from zsim_analysis.report.figure_style import COLUMN_IN, ReportFigure, new_figure

PNG = b"\x89PNG"


def axes_png(figure: ReportFigure) -> bytes:
    """Judge the content of a figure's axes in place of its picture, which takes a second to render."""
    visible = [axes for axes in figure.drawing.axes if axes.get_visible()]
    assert visible
    assert any(axes.has_data() or axes.texts for axes in visible)
    return PNG


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make reports, comparisons and those of sweeps with one figure, which is empty."""
    figure = ReportFigure("one.png", "", "", new_figure(COLUMN_IN, 1.0))
    for module in ("report.make_report.", "sweep.sweep_report.", "report.comparison.comparison_"):
        monkeypatch.setattr(f"zsim_analysis.{module}figures", lambda *_: iter([figure]))


@pytest.fixture
def unrendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw figures, but render none of them."""
    monkeypatch.setattr(ReportFigure, "png", axes_png)
    monkeypatch.setattr(ReportFigure, "vector", lambda figure, _: axes_png(figure))
