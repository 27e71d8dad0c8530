"""`zsim mavlink serve`: the drones of a run as MAVLink vehicles on UDP. Sockets, keys, the event loop."""
