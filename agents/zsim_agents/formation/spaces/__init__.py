"""Cluster spaces: robots to cluster variables and back, with their Jacobians. Imports zsim only."""
