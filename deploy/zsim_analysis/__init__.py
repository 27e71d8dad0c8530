"""Evaluation of records, and many runs in one process: report, sweep, export, rerun. Imports zsim, world and agents.

`reading` reads a record as arrays and messages, and judges its flight; `in_process` flies.
"""
