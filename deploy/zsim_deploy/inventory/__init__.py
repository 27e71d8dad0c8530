"""The inventory: hosts and how to reach them, which process runs where, its command line, its certificate and rights.

Imports arguments.
"""
