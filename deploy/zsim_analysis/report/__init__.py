"""The report of a run, made from its record alone.

    make_report(DIR)     reads DIR/run.mcap and writes DIR/summary.json, DIR/figures/*.png, DIR/report.html
    judge(PATH)          the same without writing anything: flight, formations, summary
    compare(DIRS, OUT)   one page of several runs, side by side
    table(summary)       the formation's errors beside the paper's Table I, for the terminal

Order of the files: `reading` fills a `flight`; `formation`, `statistics` and `truth_hash` compute; `summary`
gathers; `figures`, `page` and `table` show. `comparison` sets several runs side by side; the files that begin with its
name show that.
"""

from zsim_analysis.report.comparison.make_comparison import compare, comparison_path
from zsim_analysis.report.error_table import table
from zsim_analysis.report.make_report import judge, make_report
from zsim_analysis.report.summary import Summary

__all__ = ["Summary", "compare", "comparison_path", "judge", "make_report", "table"]
