"""The firmware of the aircraft: what it believes, decides and drives. Imports sensors, physics, state."""
