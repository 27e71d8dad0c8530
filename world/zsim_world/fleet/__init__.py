"""The fleet of all drones, advanced gate by gate: kernel, injected faults, messages of a gate. Imports vehicles."""
