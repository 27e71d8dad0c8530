"""The run of a record flown again from its own inputs, and held against the truth on record. Imports reading."""
