"""Cluster spaces: robots to cluster variables and back, with their Jacobians; `scenario_space` knows the stock ones.

Imports zsim alone.
"""
