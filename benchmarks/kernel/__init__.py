"""Contenders of part b: drones in the air, integrated in one process, no messages.

Each file is one contender and serves measurements over its standard input and output (`stopwatch.serve`), so that all
contenders stay up, compiled and warm, and are measured in turn. Files of peers run in the environment of the peers.
"""
