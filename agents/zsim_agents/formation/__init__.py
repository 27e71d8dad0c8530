"""The cluster controller as an agent: phases, requests and plan, references, control law, limits of the robots."""
