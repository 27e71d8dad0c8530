"""The page that compares runs, in a browser: its tables are not cut off at the width of a small screen."""

from pathlib import Path
from typing import Any

import pytest
import synthetic_record
from chromium import needs_browser
from synthetic_record import Flown

from zsim_analysis.report.comparison import ComparedRun, comparison_page
from zsim_analysis.report.summary import judge

WIDTH_PX = 1280
HIDDEN_PX = "[...document.querySelectorAll('.wide')].map(each => each.scrollWidth - each.clientWidth)"


@needs_browser
@pytest.mark.parametrize("count", [2, 3])
def test_tables_of_a_comparison_fit_the_page(count: int, tmp_path: Path, browser: Any) -> None:
    synthetic_record.write(tmp_path / "run.mcap", Flown(duration_s=4.0))
    judged = judge(tmp_path / "run.mcap")
    runs = [ComparedRun(f"step-with-gusts-{number}", tmp_path, *judged) for number in range(count)]
    (tmp_path / "page.html").write_text(comparison_page(runs, []), encoding="utf-8")
    page = browser.new_page(viewport={"width": WIDTH_PX, "height": 900})
    page.goto((tmp_path / "page.html").as_uri())
    hidden = page.evaluate(HIDDEN_PX)
    assert len(hidden) > 1
    assert set(hidden) == {0}
    page.close()
