"""A custom vehicle: the AR.Drone with the larger battery, weighed. `model: larger_battery` names it.

    PYTHONPATH=examples zsim run scenarios/step.yaml --set drones.drone1.model=larger_battery

It replaces some of a stock vehicle's numbers; one that differs more starts as a copy of zsim/vehicles/crazyflie2.py.
"""

from msgspec.structs import replace

from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2

VEHICLE = replace(
    ARDRONE2,
    mass_kg=0.48,  # kg, weighed
    battery_mah=1500.0,  # mAh, printed on it
)
