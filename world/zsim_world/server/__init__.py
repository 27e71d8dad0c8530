"""The world as a process on Zenoh: its loop, inputs and outputs, deaths, journal, pacing. Imports run."""
