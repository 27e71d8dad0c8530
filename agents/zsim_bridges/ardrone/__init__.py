"""The AR.Drone 2.0 both ways: drones of a run on its wire, and the aircraft as a drone of a run."""
