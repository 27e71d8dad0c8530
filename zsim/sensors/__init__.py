"""Sensors as declarations: message, settings with errors, channels, presets. Imports schema and math.

Scenario, faults, keys, messages and the arrays of the world follow from them. What a sensor is: sensor; those there
are: stock_sensors, camera (with camera_model, its lens), and a user's own, found by sensor_catalogue.
"""
