"""A run on several hosts: planned, started over ssh, watched, its record brought home.

Imports ssh, security, launch.
"""
