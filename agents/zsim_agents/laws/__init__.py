"""Formation laws of the literature: the equations of a paper, pure, and the agent that flies them."""
