"""The report page of a board."""

from refused import has_terms, without_tags

from zsim_analysis.board.board import MEASURES, Board, Entry
from zsim_analysis.board.board_report import page


def test_the_page_explains_the_dashes_of_a_law_whose_flights_all_failed() -> None:
    unknown: dict[str, float | None] = {each.name: None for each in MEASURES}
    entry = Entry("step", "consensus", 1, 1, unknown, unknown, unknown)
    text = without_tags(page(Board(["consensus"], ["step"], 1, "0.1.0", [entry]), []))
    assert text.count("–") >= len(MEASURES)
    assert has_terms(text, "dash", "no such measure", "flights failed")
