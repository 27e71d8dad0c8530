"""The contract: keys, messages, their bytes, what a process may read of the world's events. Imports schema."""
