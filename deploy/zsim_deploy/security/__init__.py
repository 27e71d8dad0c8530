"""Certificates, keys and access control for each process and host. Imports inventory."""
