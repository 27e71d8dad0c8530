"""A flight in one file: written from the folder of a run, checked, and flown again on another machine."""
