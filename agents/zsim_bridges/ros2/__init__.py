"""ROS 2 by rmw_zenoh's wire: the drones as topics and services, with nothing of ROS installed."""
