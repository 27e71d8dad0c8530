"""The figures of a report: the paper's Figures 5 to 8, and the drones' own. Imports reading."""
