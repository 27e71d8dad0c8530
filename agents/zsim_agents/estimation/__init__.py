"""Estimators of drones: from sensor readings to an estimate at every gate. Imports zsim only.

estimator (the agent) -> estimator_bank (one step for all drones) or joint_filter (of a cluster) -> measurement_update
and strapdown -> kalman_update. Columns of a row: filter_state; initial values: filter_setup. Instead of these:
paper_estimator, or a class of the user's (drone_estimator).
"""
