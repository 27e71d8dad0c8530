"""Runs the roles as processes, and stops them. Imports arguments, and the packages that implement the roles."""
