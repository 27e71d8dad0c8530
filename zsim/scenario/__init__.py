"""The scenario of a run and what follows from it: its fields, files and checks, the processes, the faults to inject.

Imports vehicles, contract, sensors and schema.
"""
