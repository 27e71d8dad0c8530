"""What bridges to the wire of a real aircraft share, whichever wire it is."""
