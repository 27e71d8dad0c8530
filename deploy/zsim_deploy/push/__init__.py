"""`zsim push`: wheels gathered here and installed on hosts that have no internet. Imports hosts, roles, inventory."""
