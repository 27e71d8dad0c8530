"""The run of a record flown again from its own inputs, and compared with the truth on record. Imports reading."""
