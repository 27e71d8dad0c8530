"""Sensors as declarations: message, settings with errors, channels, presets; a file for each.

Scenario, faults, keys, messages and the arrays of the world follow from them. The equations of the stock sensors are
compiled in zsim_world.sensors; a user's sensor brings its own. Imports schema and math.
"""
