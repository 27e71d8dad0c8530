"""The world as a process on Zenoh: its loop, what comes in and goes out, deaths, history, pacing. Imports flight."""
