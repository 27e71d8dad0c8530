"""A record read: its messages, a flight as arrays, its formations, their errors, and the verdict on the flight."""
