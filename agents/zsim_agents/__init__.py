"""Agents (estimators, controllers, pilots, recorder), camera processes, and the computations that they use.

`estimation` and `formation` do not import each other; `recorder` writes the record of a run; `hosting` creates the
agents of a process by name. The package imports only zsim; agents receive what they need from the world as messages.
"""
