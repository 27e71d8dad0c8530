"""All drones, one gate at a time: the kernel, its start, injected faults, and the messages of a gate.

Imports vehicles.
"""
