"""Formation laws from the literature, one per module: a paper's equations as pure functions, and the agent."""
