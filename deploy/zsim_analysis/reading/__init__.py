"""A record read as arrays: a flight, its formations, its errors. Imports zsim.record and the cluster spaces."""
