"""Show a run and translate it: console, gateway, ROS 1, ROS 2, MAVLink, AR.Drone; each a room of its own.

They never gate. Imports zsim and the mathematics of zsim_agents; of other rooms each uses `vehicle_links` and `web`.
"""
