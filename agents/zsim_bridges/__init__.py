"""Programs that show or translate a run: console, gateway, ROS 1, ROS 2, MAVLink and AR.Drone, all independent.

The world waits for none of them. They import zsim and the mathematics of zsim_agents; apart from its own package, each
uses only `vehicle_links` and `web`.
"""
