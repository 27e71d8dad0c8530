"""The scenario of a run: its fields, files and checks, and the processes and injected faults it implies.

Imports vehicles, contract, sensors, schema and math.
"""
