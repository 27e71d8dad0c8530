"""The drones in a ROS 1 graph, under the names and with the messages of ardrone_autonomy, without ROS on this host.

Imports zsim, the frames of ROS beside it, and the attitude filter of zsim_agents.estimation; no other bridge.
"""
