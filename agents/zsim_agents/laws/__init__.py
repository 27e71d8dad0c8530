"""Formation laws of the literature, one a file: the equations of its paper, pure, and the agent that flies them."""
