"""All drones, one gate at a time: the kernel, injected faults, and the messages of a gate. Imports vehicles."""
