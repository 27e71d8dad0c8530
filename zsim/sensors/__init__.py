"""Sensors as declarations: message, settings with errors, channels, presets. Imports schema and math.

Scenario, faults, keys, messages and the world's arrays derive from them. `sensor` defines what a sensor is; the sensors
are in `stock_sensors`, `scanner`, `camera` (its lens in `camera_model`), and users' modules, which `sensor_catalogue`
finds.
"""
