"""The HTML around viser's page: the head, the tools over the scene, the windows of the drones' cameras."""
