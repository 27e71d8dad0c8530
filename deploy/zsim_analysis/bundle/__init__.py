"""A flight in one file: written from a run's folder, checked, and flown again on another machine."""
