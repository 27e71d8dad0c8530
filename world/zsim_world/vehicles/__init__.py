"""The firmware of the aircraft: state estimate, decisions and motor commands. Imports sensors and physics."""
