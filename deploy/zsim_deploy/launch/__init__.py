"""A run on this host: processes started, supervised, ended. Imports roles and inventory."""
