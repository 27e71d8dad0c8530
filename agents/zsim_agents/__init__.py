"""Agents: estimator, cluster controller and recorder, and the pure mathematics they use.

`estimation` and `formation` do not import each other; `recorder` writes the record of a run; `hosting` makes the agents
of a process by their names. Imports zsim alone; what agents need of the world comes over keys.
"""
