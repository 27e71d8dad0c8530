"""A drone as a MAVLink vehicle: what its clients send, and what they get. Pure: no clock, no sockets."""
