"""Pictures of the drones and their field, from true poses, by OpenCV on one thread."""

import cv2

cv2.setNumThreads(1)  # the processors are the world's and the agents'; and one thread gives the same bits everywhere
