"""Processes that show a run and translate it: console, gateway, ROS 1, ROS 2.

They never gate. Imports zsim and zsim_agents' mathematics.
"""
