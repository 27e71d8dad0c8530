"""Independent programs that show or translate a run: console, gateway, ROS 1, ROS 2, MAVLink and AR.Drone.

The world waits for none of them. They import zsim and the mathematics of zsim_agents; of zsim_bridges, each imports
only its own package, `vehicle_links` and `web`.
"""
