"""The world: vehicles, their firmware, sensors, wind and contacts, and the process that owns simulated time.

Rooms from the ground: state, physics, sensors, vehicles, fleet (the compiled kernel over all drones), flight (a run
without session or wall clock), server (the process), playback (a record in place of a flight); a room imports those
below it, and zsim. Agents and bridges are met on keys only.
"""
