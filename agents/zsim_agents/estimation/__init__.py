"""Estimators of drones: sensors in, rows moved and corrected, an estimate out at every gate. Imports zsim alone.

estimator (the agent) -> estimator_bank (one step for all drones) -> strapdown, measurement_update -> mathematics
(dead_reckoning, madgwick, kalman_update). What a row holds: filter_state; how it begins:
filter_setup. In its place: paper_estimator, or a class of the user's (drone_estimator).
"""
