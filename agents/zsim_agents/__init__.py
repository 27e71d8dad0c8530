"""Agents: estimator, cluster controller and recorder, and the pure mathematics they use.

`estimation` and `formation` do not import each other; `recorder` writes the record of a run; `hosting` creates the
agents of a process by name. Imports only zsim; what agents need from the world comes over keys.
"""
