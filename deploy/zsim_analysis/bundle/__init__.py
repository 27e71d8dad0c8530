"""A flight in one file: made from the folder of a run, checked, and flown again on another machine."""
