"""Handwritten documents: read within limits, checked against types, naming users' modules. Imports errors."""
