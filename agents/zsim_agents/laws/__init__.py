"""Formation laws of the literature, one per file: the equations of the paper, pure, and the agent that applies them."""
