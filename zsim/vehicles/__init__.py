"""Vehicles as data: `vehicle` has their parameters and finds one by the name of its model; a file per stock vehicle.

That file states numbers with unit and source, and nothing else; the equations that use them are in zsim_world.
Imports schema.
"""
