"""References of single drones: paths, cruises to goals, their combination into flights, and the pilot of one drone."""
