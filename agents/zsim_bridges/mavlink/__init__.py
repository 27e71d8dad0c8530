"""MAVLink in both directions: drones of a run as MAVLink vehicles, and a MAVLink vehicle as a drone of a run."""
