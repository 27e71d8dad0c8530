"""Contenders of part b: drones in the air, simulated in one process, without messages.

Each contender is a process that serves measurements over its standard input and output (`stopwatch.serve`), so that all
contenders stay up, compiled and warm, and are measured in turn. Peers run in an environment of their own.
"""
