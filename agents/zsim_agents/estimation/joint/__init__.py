"""The joint filter of the drones of a cluster: one covariance of all their errors, by which sightings are used.

Each estimator of such a cluster reads the sensors of all its drones and computes the same filter; it publishes its own
drones' estimates. Stands on the rows and the updates of `zsim_agents.estimation`.
"""
