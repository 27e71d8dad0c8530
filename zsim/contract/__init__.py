"""The contract: which messages are published on which keys, how they are encoded, and what makes runs comparable.

`keys`, `flight_messages`, `run_messages` and `messages` declare its keys; `messages` also encodes and decodes. Imports
sensors, schema and math.
"""
