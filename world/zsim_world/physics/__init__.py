"""Compiled equations of motion: rigid body, rotors, battery, ground, obstacles, wind, contacts between drones."""
