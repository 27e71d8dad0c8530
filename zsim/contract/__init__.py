"""The contract: which messages are published on which keys, how they are encoded, and what makes runs comparable.

`keys`, `flight_messages` and `run_messages` declare all of it; `messages` encodes and decodes. Imports sensors and
schema.
"""
