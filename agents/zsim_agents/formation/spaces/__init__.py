"""Cluster spaces: conversions between robot poses and cluster variables, with their Jacobians. Imports only zsim."""
