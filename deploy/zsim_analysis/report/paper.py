"""What the paper printed.

I. Mas, S. Curi, R. Sanchez Pena, Open-source Multi-UAV Simulator for the ROS Environment.
"""

# Table I: standard deviation of the formation parameters for Test 1 after steady state; m and rad.
TABLE_1 = {
    "x_c": 0.11,
    "y_c": 0.22,
    "z_c": 0.13,
    "roll": 0.004,
    "pitch": 0.0025,
    "yaw": 0.044,
    "p": 0.032,
    "q": 0.035,
    "beta": 0.012,
}

NOTE = (
    "With GPS errors of 2.0 m that are independent from drone to drone, the error of a distance between two "
    "drones is √6 = 2.45 times the error of a coordinate of their centroid, whatever filter each of them "
    "uses on its own. In Table I p and q are 0.15 to 0.32 times x_c and y_c. So these figures cannot be "
    "reached in truth with the set-up that the paper describes; they can be read as deviations of the "
    "estimate from the desired value, which a controller makes small even when the estimate is wrong. "
    "Compare the column est. std with the paper, and judge the flight by the columns of the truth."
)
