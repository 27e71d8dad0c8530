"""MAVLink 1 and 2 as bytes: messages, frames, signatures. Pure: no clock, no sockets."""
