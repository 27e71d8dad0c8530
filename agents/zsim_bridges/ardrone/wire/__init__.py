"""The AR.Drone's wire, SDK 2.0: bytes to values and back. Pure."""
