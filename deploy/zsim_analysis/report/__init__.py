"""The report of a run, from its record alone, and the comparison of several runs.

    make_report(DIR)     reads DIR/run.mcap and writes DIR/summary.json, DIR/figures/*.png, DIR/report.html
    judge(PATH)          returns flight, formations and summary without writing files; needs no matplotlib
    compare(DIRS, OUT)   one page with several runs, side by side
    terminal_text(summary)   shortfalls and errors of the formations, for the terminal

Imports zsim_analysis.reading, matplotlib and jinja2.
"""

from typing import Any, Literal

import msgspec

FORMATS = ("pdf", "svg")  # formats of figures besides PNG


def indented_json(content: Any, order: Literal["sorted"] | None = None) -> bytes:
    """Return content as indented JSON, as in summary.json."""
    return msgspec.json.format(msgspec.json.encode(content, order=order), indent=2) + b"\n"
