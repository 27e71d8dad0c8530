"""What the console draws: aircraft, trails, formation, wind, plots. Imports zsim alone."""
