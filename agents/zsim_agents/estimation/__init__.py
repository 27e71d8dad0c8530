"""Estimators, which turn the sensor readings of drones into an estimate at every gate. Imports only zsim.

Modules from the top: estimator (the agent) -> estimator_bank (one step for all drones) or joint_filter (one filter for
a cluster) -> measurement_update and strapdown -> kalman_update. filter_state defines the columns of the filter's
arrays, filter_setup their initial values. Instead of this filter, the agent can run paper_estimator or a user's class
(drone_estimator).
"""
