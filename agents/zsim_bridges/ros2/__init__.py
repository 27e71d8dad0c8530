"""The drones as ROS 2 topics and services, on the wire of rmw_zenoh, without ROS on this host."""
