"""The drones as ROS 2 topics and services, on the wire of rmw_zenoh, without ROS on this host.

Imports zsim, the observer process and the frames of ROS beside it; no other bridge.
"""
