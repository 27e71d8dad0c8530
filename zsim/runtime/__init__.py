"""Agents and their runners, gate by gate, on Zenoh or on an in-memory bus. Imports transport and all below it."""
