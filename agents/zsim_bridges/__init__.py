"""Programs that show a run or translate it: console, gateway, ROS 1, ROS 2, MAVLink and AR.Drone, each by itself.

The world waits for none of them. Imports zsim and the mathematics of zsim_agents; besides its own room each uses
`vehicle_links` and `web`.
"""
