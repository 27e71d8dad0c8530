"""The estimator of drones: attitude, dead reckoning, error-state Kalman filter. Imports zsim alone."""
