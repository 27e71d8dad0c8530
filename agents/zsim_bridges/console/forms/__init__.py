"""Forms of the console: what an operator asks of the run, of drones, formations and faults. Imports scene."""
