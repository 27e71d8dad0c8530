"""Evaluation of records, and runs in one process: report, sweep, export, rerun.

`reading` reads a record as arrays and messages and judges its flight; `in_process` runs a flight in one process.
Imports zsim, zsim_world and zsim_agents.
"""
