"""One drone of a run as an AR.Drone 2.0: messages and datagrams in, commands and datagrams out. Pure."""
