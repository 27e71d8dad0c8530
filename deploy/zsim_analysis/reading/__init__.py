"""A record read as arrays: a flight, its formations, their errors. Imports zsim.record and the cluster spaces."""
