"""The report of a run, made from its record alone.

    make_report(DIR)     reads DIR/run.mcap and writes DIR/summary.json, DIR/figures/*.png, DIR/report.html
    judge(PATH)          the same without writing anything: flight, formations, summary
    compare(DIRS, OUT)   one page of several runs, side by side
    table(summary)       the formation's errors beside the paper's Table I, for the terminal

Order of the files: `reading` fills a `flight`; `formation`, `statistics` and `truth_hash` compute; `summary`
gathers; `figures`, `page` and `table` show. `comparison` sets several runs side by side; the files that begin with its
name show that.
"""

from zsim_deploy.report.compare import compare, comparison_path
from zsim_deploy.report.make import judge, make_report
from zsim_deploy.report.summary import Summary
from zsim_deploy.report.table import table

__all__ = ["Summary", "compare", "comparison_path", "judge", "make_report", "table"]
