"""The roles as processes, and how they learn that they are to stop. Imports world, agents, bridges."""
