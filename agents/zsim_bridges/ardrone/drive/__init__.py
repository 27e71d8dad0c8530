"""An AR.Drone 2.0 as a drone of a run: what a driver reads of it and sends to it. Pure."""
