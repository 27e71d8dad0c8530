"""Fixtures of the tests of reports."""

import pytest

from zsim_analysis.report.figure_style import ReportFigure

PNG = b"\x89PNG"


def axes_png(figure: ReportFigure) -> bytes:
    """Judge the content of a figure's axes in place of its picture, which takes a second to render."""
    visible = [axes for axes in figure.drawing.axes if axes.get_visible()]
    assert visible
    assert any(axes.has_data() or axes.texts for axes in visible)
    return PNG


@pytest.fixture
def unrendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw figures, but render none of them."""
    monkeypatch.setattr(ReportFigure, "png", axes_png)
    monkeypatch.setattr(ReportFigure, "vector", lambda figure, _: axes_png(figure))
