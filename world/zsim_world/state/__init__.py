"""The arrays that a fleet consists of, and the aircraft's parameters: what physics, sensors and firmware read.

Imports zsim alone.
"""
