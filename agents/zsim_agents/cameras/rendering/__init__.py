"""Pictures of the drones and their field, from true poses, by OpenCV on one thread."""

import cv2

cv2.setNumThreads(1)  # other cores belong to the world and the agents; one thread gives the same bits everywhere
