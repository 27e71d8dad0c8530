"""The contract: keys, messages by topic, their bytes one by one and many at once, and what makes runs comparable.

Imports schema.
"""
