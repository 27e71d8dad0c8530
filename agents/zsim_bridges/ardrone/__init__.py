"""The AR.Drone 2.0 in both directions: drones of a run as AR.Drones, and a real aircraft as a drone of a run."""
