"""Vehicles as data: `vehicle` defines their parameters and finds a vehicle by the name of its model.

Each stock vehicle has a file that only states numbers with their units and sources; the equations that use them are in
zsim_world. Imports schema and math.
"""
