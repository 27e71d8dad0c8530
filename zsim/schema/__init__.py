"""Documents that people write: YAML, every fault against a typed description, and the user's classes they name.

Imports errors.
"""
