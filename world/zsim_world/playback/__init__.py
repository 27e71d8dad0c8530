"""A record played back onto the keys by a process that stands in for the world. Imports flight."""
