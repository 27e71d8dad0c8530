"""What every process of a federation shares: time, frames, keys, messages, scenario, session, agent."""

__version__ = "0.1.0"
CONTRACT = 1
