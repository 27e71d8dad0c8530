"""Documents that people write: YAML, the check of every field against its type, and the user's classes they name.

Imports errors.
"""
