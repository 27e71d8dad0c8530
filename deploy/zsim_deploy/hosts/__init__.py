"""A run on several hosts: checked by `zsim doctor`, planned, started over ssh, watched, its record brought home.

`ssh_connection`, `host_link` and `host_links` reach the hosts, for `zsim push` too. Imports launch, roles, inventory.
"""
