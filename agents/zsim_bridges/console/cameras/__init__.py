"""The pictures of the drones' cameras: received, checked, with the marks of what is seen in them. Imports no viser."""
