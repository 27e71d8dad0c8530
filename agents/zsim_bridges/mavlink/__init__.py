"""MAVLink in both directions: presents a run's drones as MAVLink vehicles, and a MAVLink vehicle as a drone."""
