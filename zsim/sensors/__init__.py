"""Sensors as declarations: message, settings with errors, channels, presets.

    sensor             what a sensor is, stock or of a user's own
    stock_sensors      IMU, GPS, magnetometer, barometer, sonar, optical flow
    camera             settings of cameras, sightings and hats; the header of a JPEG
    camera_model       lenses: points to pixels and back
    sensor_catalogue   all sensors of a drone, those of users found by their modules
    error_units        error models in the units of data sheets and of Kalibr

Scenario, faults, keys, messages and the arrays of the world follow from the declarations. Imports schema and math.
"""
