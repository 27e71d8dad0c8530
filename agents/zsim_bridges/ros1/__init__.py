"""The drones on ROS 1, under the names and with the messages of ardrone_autonomy, without ROS on this side."""
