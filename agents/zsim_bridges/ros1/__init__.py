"""Presents the drones in a ROS 1 graph, with the names and messages of ardrone_autonomy; needs no ROS on this host."""
