"""ROS 1 on the wire without ROS: master, TCPROS, XML-RPC, message types. Imports nothing of a run."""
