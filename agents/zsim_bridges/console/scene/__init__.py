"""The 3-D scene of the page: poses, shapes and trails as arrays, the nodes that draw them, the cameras of pages."""
