"""Sensors as declarations: message, settings with errors, channels, presets. Imports schema and math.

Scenario, faults, keys, messages and the arrays of the world follow from them. `sensor` defines what a sensor is;
all of them are in `stock_sensors`, `camera` (its lens in `camera_model`), and the users' modules, which
`sensor_catalogue` finds.
"""
