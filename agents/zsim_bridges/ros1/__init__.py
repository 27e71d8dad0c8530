"""The drones in a ROS 1 graph, under the names and with the messages of ardrone_autonomy, without ROS on this host."""
