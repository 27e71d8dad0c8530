"""The AR.Drone 2.0's protocol in both directions: presents a run's drones as AR.Drones, and a real one to a run."""
