"""A run on this host: starts, supervises and ends its processes. Imports roles and inventory."""
