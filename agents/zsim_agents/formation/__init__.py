"""The cluster controller as an agent: flight phases, requests and plans, references, control laws, robots' limits."""
