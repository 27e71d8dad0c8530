"""The world: vehicles, their firmware, sensors, wind and contacts, and the process that owns simulated time.

The packages, from the bottom up, are physics, sensors, vehicles (the firmware), fleet (the compiled kernel for all
drones), run (the rules of a flight or a replay, without session or wall clock) and server (the process). Each imports
only those below it and zsim. The world shares nothing but messages with agents and bridges.
"""
