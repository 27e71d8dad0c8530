"""The inventory: hosts, how to reach them, which role runs where, what they need. Imports zsim.schema."""
