"""The AR.Drone 2.0 protocol, both ways: a run's drones presented as AR.Drones, and a real one linked to a run."""
