"""The contract: what travels on which key, how it is encoded, and what makes runs comparable.

`keys` and the declarations of `flight_messages` and `run_messages` are the whole of it; `messages` encodes and decodes.
Imports sensors and schema.
"""
