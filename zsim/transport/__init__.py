"""Zenoh: sessions, their settings, TLS, and how a process finds the world.

`session` alone imports zenoh. Imports scenario.
"""
