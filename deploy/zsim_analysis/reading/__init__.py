"""Reading of records: messages, a flight as arrays, its formations and their errors, and the verdict on the flight."""
