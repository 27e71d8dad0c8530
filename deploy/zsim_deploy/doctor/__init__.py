"""Whether the hosts of an inventory can fly together, looked at before anything is started on them. Imports ssh."""
