"""What judges records and flies many runs in one process: report, sweep, export, rerun. Imports zsim, world, agents.

`reading` has a record as arrays and messages; `in_process` and `rerun_bus` fly; the others show and write.
"""
