"""References of single drones: paths, the goals of several drones, and the pilot that flies one."""
