"""The terminal: interrupts and signals, and a report as it is made. Imports zsim alone."""
