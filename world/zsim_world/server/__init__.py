"""The world as a process on Zenoh: loop, inputs and outputs, liveliness, journal, pacing. Imports run."""
