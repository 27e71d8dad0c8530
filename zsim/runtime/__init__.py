"""Agents and their runners, gate by gate, on Zenoh or an in-memory bus. Imports scenario, transport and all below."""
