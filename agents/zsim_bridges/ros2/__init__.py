"""Presents the drones as ROS 2 topics and services on the wire of rmw_zenoh; needs no ROS on this host."""
