"""What ps, logs, restart, move and down ask of the `zsim up` that runs, over a local socket. Imports hosts."""
