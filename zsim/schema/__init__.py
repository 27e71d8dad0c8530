"""Handwritten documents: reading within limits, type checks, and users' modules named in them. Imports errors."""
