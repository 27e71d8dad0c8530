"""What an autopilot is to its clients: enumerations, axes, modes, parameters, and the state of its vehicle. Pure."""
