"""The report of a run, made from its record alone.

    make_report(DIR) reads DIR/run.mcap and writes DIR/summary.json, DIR/figures/*.png, DIR/report.html
    table(summary)   the formation's errors beside the paper's Table I, for the terminal

Order of the files: `flight` reads, `formation`, `statistics` and `truth_hash` compute, `summary` gathers,
`figures`, `page` and `table` show.
"""

from zsim_deploy.report.make import make_report
from zsim_deploy.report.summary import Summary
from zsim_deploy.report.table import table

__all__ = ["Summary", "make_report", "table"]
