"""Processes that show a run and translate it: console, gateway, ROS 1, ROS 2; each a room of its own.

They never gate. Imports zsim and the mathematics of zsim_agents; no room imports another one.
"""
