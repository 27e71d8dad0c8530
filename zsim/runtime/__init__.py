"""Agents and their runners, on Zenoh or on an in-memory bus, gate by gate. Imports transport and all below it."""
