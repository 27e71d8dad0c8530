"""A run on several hosts: installed by `zsim push`, checked by `zsim doctor`, started, watched and fetched over ssh.

`host_link` reaches the hosts; `probe` and `on_host` run there. Imports launch, roles, certificates, inventory.
"""
