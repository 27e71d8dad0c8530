"""Agents: estimator, cluster controller and recorder, and the pure mathematics they use."""
