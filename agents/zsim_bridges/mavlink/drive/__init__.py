"""A MAVLink vehicle as a drone of a run: what a driver reads of it and sends to it. Pure."""
