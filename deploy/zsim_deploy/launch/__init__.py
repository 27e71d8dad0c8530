"""Starts, supervises and ends the processes of a run on this host. Imports roles and inventory."""
