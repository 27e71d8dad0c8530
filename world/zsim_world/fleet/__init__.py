"""The fleet of all drones, one gate at a time: kernel, injected faults, messages of a gate. Imports vehicles."""
