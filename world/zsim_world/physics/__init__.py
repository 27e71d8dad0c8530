"""Compiled equations of motion: body, rotors, ground, wind, battery, encounters, obstacles. Imports state."""
