"""The firmware of the aircraft: its state estimate, decisions and motor commands. Imports sensors and physics."""
