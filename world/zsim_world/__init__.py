"""The world: vehicles, their firmware, sensors, wind and contacts, and the process that owns simulated time.

Packages from the bottom up: physics, sensors, vehicles (the firmware), fleet (the compiled kernel over all drones), run
(the rules of a flight or a replay, without session or wall clock), server (the process). Each imports those below it,
and zsim. The world interacts with agents and bridges through messages only.
"""
