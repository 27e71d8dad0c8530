"""Evaluation of records, and runs in one process: report, sweep, export, rerun. Imports zsim, world and agents.

`reading` reads a record as arrays and messages and judges its flight; `in_process` runs a flight in one process.
"""
