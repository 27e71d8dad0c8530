"""Handwritten documents (limits, type checks, users' modules named in them) and message types. Imports errors."""
