"""What a scenario says, how its file is read, and what follows from it: rights, faults, streams.

Imports contract, schema.
"""
