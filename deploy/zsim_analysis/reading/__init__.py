"""A record read: its messages, a flight as arrays, its formations and their errors. Imports zsim.record and agents."""
