"""All drones of a scenario, advanced gate by gate: kernel, faults, messages. Imports physics, sensors and vehicles."""
