"""A drone as a MAVLink vehicle: an autopilot's modes, missions, parameters and telemetry. Pure: no clock, no sockets.

It is handed messages of the drone and of MAVLink clients; commands to the drone and messages for clients come out.
"""
