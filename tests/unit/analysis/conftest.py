"""Fixtures for the tests of reports."""

import pytest

from zsim_analysis.report.figure_style import COLUMN_IN, ReportFigure, new_figure

PNG = b"\x89PNG"


def axes_png(figure: ReportFigure) -> bytes:
    """Check the content of a figure's axes instead of rendering its picture, which takes a second."""
    visible = [axes for axes in figure.drawing.axes if axes.get_visible()]
    assert visible
    assert any(axes.has_data() or axes.texts for axes in visible)
    return PNG


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give reports of runs, sweeps and comparisons a single, empty figure."""
    figure = ReportFigure("one.png", "", "", new_figure(COLUMN_IN, 1.0))
    for module in ("report.make_report.", "sweep.sweep_report.", "report.comparison.comparison_"):
        monkeypatch.setattr(f"zsim_analysis.{module}figures", lambda *_: iter([figure]))


@pytest.fixture
def unrendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw figures without rendering them."""
    monkeypatch.setattr(ReportFigure, "png", axes_png)
    monkeypatch.setattr(ReportFigure, "vector", lambda figure, _: axes_png(figure))
