"""The HTML added to viser's page: the head, the tools over the scene, and the windows of the drones' cameras."""
