"""A run on several hosts: checked by `zsim doctor`, planned, started over ssh, watched, its record brought home.

Imports launch, roles, ssh, security, inventory.
"""
