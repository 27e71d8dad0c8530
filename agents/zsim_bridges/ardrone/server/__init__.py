"""The drones of a run as AR.Drones on addresses of this host: sockets and keys."""
