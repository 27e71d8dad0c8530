"""Runs on several hosts: zsim is installed and the hosts are checked, then a run is started and supervised over ssh.

`host_link` reaches the hosts; `probe` and `on_host` run there. Lower layers: launch, roles, certificates, inventory.
"""
