"""Judging of records, and many runs in one process: report, sweep, export, rerun. Imports zsim, world and agents.

`reading` has a record as arrays and messages, and the verdict on its flight; `in_process` flies.
"""
