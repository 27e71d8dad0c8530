"""The HTML added to viser's page: the head, the tools overlaid on the scene, and the windows of the drones' cameras."""
