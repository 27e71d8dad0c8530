"""The fleet of all drones, advanced gate by gate: kernel, faults, gate messages. Imports physics, sensors and vehicles."""
