"""Sensors as declarations: message, settings with error models, channels, presets. Imports schema and math.

The scenario's fields, the faults, keys and messages, and the world's arrays derive from them. `sensor` defines what a
sensor is. zsim's own sensors are in `stock_sensors`, `scanner` and `camera` (its lens in `camera_model`);
`sensor_catalogue` finds those in users' modules.
"""
