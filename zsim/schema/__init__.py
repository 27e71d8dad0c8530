"""Documents that people write, checked as a whole: YAML, and typed descriptions with every fault told.

Imports errors.
"""
