"""Options that several commands share. Imports zsim alone."""
