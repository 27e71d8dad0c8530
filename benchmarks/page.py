"""The measured sections of benchmarks/README.md: what stands between two marks is replaced, the rest stays."""

from pathlib import Path

from benchmarks.peers import ROOT

PAGE = ROOT / "benchmarks" / "README.md"
PICTURES = ROOT / "benchmarks" / "results"


def replaced(text: str, part: str, content: str) -> str:
    """Return the text with the section of a part replaced.

    Raises:
        ValueError: the text has no such section.
    """
    begin, end = f"<!-- measured: {part} -->\n", f"<!-- end: {part} -->"
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise ValueError(
            f"benchmarks/README.md: has no lines {begin.strip()} and {end}; put them where part {part} goes"
        )
    return f"{before}{begin}{content.strip()}\n{end}{after}"


def update(part: str, content: str, page: Path = PAGE) -> None:
    """Replace the section of a part in the page."""
    page.write_text(replaced(page.read_text(), part, content))
