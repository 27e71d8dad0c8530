"""A run without session and clock: who takes part, commands, faults, requests, refusals. Imports fleet."""
