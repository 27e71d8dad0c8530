"""The scenario: its fields, how its file is read, and what follows from it: roles, rights, faults.

Imports contract, schema.
"""
