"""Roles forked from one process that has everything imported. Imports roles."""
