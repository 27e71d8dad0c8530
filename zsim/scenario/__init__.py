"""The scenario of a run: its fields, files and checks, and the processes and injected faults that follow from it.

Imports vehicles, contract, sensors and schema.
"""
