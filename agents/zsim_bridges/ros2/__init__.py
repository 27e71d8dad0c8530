"""Presents the drones as ROS 2 topics and services in the wire format of rmw_zenoh; needs no ROS on this host."""
