"""Vehicles as data: the class of their parameters, one file per stock vehicle, and the catalogue that finds them.

A file here states numbers with unit and source, and nothing else; the equations that use them are in zsim_world.
Imports schema.
"""
